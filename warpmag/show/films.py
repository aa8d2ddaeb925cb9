"""Writes pictures as single files, or as a film."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from warpmag.errors import InputError, extra

FILMS = (".mp4", ".webp", ".gif")
SUFFIXES = (".png", *FILMS)
_LOOP_RATE = 25.0
"""Largest rate of a GIF or WebP [Hz]: players slow down faster GIFs."""
_WEBP = {"quality": 70, "method": 6}
"""Quality, at most 100, and effort of compression, at most 6."""


def check_name(output: Path) -> None:
    """Raise :class:`InputError` unless the suffix names a format whose writer is installed."""
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(f"{output}: a picture is written as .png, a film as .mp4, .webp or .gif")
    if output.suffix.lower() == ".mp4":
        _ffmpeg()


def write(output: Path, pictures: Iterable[np.ndarray], frames: list[int], rate: float) -> list[Path]:
    """Write one file for a film, else one for each picture. Names of several pictures contain the frame numbers.

    Pictures are 8-bit sRGB, shape [height, width, 3]; an iterator may make them one by one. The rate of a film is in
    pictures per second [Hz]. Returns the files; raises :class:`InputError` if one cannot be written.
    """
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        kind = output.suffix.lower()
        if kind == ".mp4":
            _write_mp4(output, pictures, rate)
        elif kind in FILMS:
            _write_loop(output, pictures, rate)
        else:
            return list(_write_each(output, pictures, frames))
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror or error})") from None
    return [output]


def _write_each(output: Path, pictures: Iterable[np.ndarray], frames: list[int]) -> Iterator[Path]:
    for frame, picture in zip(frames, pictures, strict=True):
        path = output if len(frames) == 1 else output.with_stem(f"{output.stem}.{frame:04}")
        Image.fromarray(picture).save(path, optimize=True)
        yield path


def stride_of(output: Path, rate: float) -> int:
    """Return the stride of the frames that a film has, of those at a rate [Hz]."""
    return 1 if output.suffix.lower() == ".mp4" else math.ceil(rate / _LOOP_RATE)


def _write_loop(output: Path, pictures: Iterable[np.ndarray], rate: float) -> None:
    images = (Image.fromarray(picture) for picture in pictures)
    duration = 10 * round(100.0 / rate)  # ms; a GIF counts in hundredths of a second
    options = _WEBP if output.suffix.lower() == ".webp" else {}
    next(images).save(output, save_all=True, append_images=images, duration=duration, loop=0, **options)


def _write_mp4(output: Path, pictures: Iterable[np.ndarray], rate: float) -> None:
    writer = None
    for picture in pictures:
        height, width = (2 * (size // 2) for size in picture.shape[:2])  # yuv420p needs even sizes
        if writer is None:
            settings = {"fps": rate, "codec": "libx264", "quality": 8, "macro_block_size": 2}
            writer = _ffmpeg().write_frames(str(output), (width, height), **settings)
            writer.send(None)
        writer.send(np.ascontiguousarray(picture[:height, :width]))
    if writer is not None:
        writer.close()


def _ffmpeg():
    try:
        import imageio_ffmpeg  # noqa: PLC0415 - an extra
    except ImportError:
        raise InputError(f"a film as .mp4 needs {extra('video')}; .webp and .gif need nothing") from None
    return imageio_ffmpeg
