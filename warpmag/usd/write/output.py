"""Files of a run on disk: temporary files, their placement, the lock and the checkpoint.

The files for ``out.usda`` are ``out.usda`` and ``out.cache.usdc``; ``out.instances.usdc`` for scenes with instancers of
bodies; ``out.scene.usdc`` or the folder ``out.scene`` for a copied scene; ``out.resume.npz`` until the run is complete;
and ``.out.lock`` and a folder ``.out.tmp*`` during the run. Files are written to that folder and moved when complete.
"""

import contextlib
import errno
import fcntl
import glob
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf

from warpmag.errors import InputError
from warpmag.usd.paths import usable_path
from warpmag.usd.read.trial_read import irregular_file
from warpmag.usd.values import quiet

_SUFFIXES = (".usd", ".usda", ".usdc")
_SCENES = (".usdc", ".usdz")
_HEADER = "about"
_FORMAT = 4
"""Version of the checkpoint format. Increase it with each change of its content, here or in the engine's state."""
_UNLOCKABLE = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)
"""Errors of file systems without locks."""


class Output:
    """The files of a run."""

    def __init__(self, path: str | os.PathLike, scene: set[Path], *, copy_scene: bool = False):
        """Check that the files can be written; nothing is written yet.

        ``path`` is the file of the root layer, ``scene`` the resolved paths of the scene's files, which must not be
        overwritten.
        """
        self.root = usable_path(path, "output")
        if self.root.suffix not in _SUFFIXES:
            raise InputError(f"{self.root}: the output must end in {', '.join(_SUFFIXES)}")
        self.cache = self.beside(".cache.usdc")  # the layer with the motion
        self.instances = self.beside(".instances.usdc")  # the layer with the prims of instances
        self.checkpoint = self.beside(".resume.npz")
        self._lock = -1
        self._folder: Path | None = None
        copies = [self.beside(f".scene{end}") for end in _SCENES] if copy_scene else []
        with self.errors(self.root):
            self._check(scene, [self.root, self.cache, self.instances, *copies])

    def beside(self, ending: str) -> Path:
        """Return the file of the same stem with another ending."""
        return self.root.with_name(f"{self.root.stem}{ending}")

    def files(self) -> list[Path]:
        """Return the files that the root layer may refer to, with the root layer, and without a scene elsewhere."""
        copies = [self.beside(f".scene{end}") for end in _SCENES]
        return [self.root, self.cache, self.instances, *copies, *self.beside(".scene").rglob("*")]

    def _check(self, scene: set[Path], targets: list[Path]) -> None:
        for target in targets:
            if target.resolve() in scene:
                raise InputError(f"{self.root}: would overwrite {target}, which belongs to the scene")
            if target.is_dir():
                raise InputError(f"{self.root}: {target} is a directory")
        folder = self.root.absolute().parent
        while not folder.exists():
            folder = folder.parent
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            raise InputError(f"{self.root}: cannot write to {folder}")
        longest = f".{self.root.stem}.tmp01234567"
        if len(os.fsencode(longest)) > os.pathconf(folder, "PC_NAME_MAX"):
            raise InputError(f"{self.root}: the name is too long")

    @staticmethod
    @contextlib.contextmanager
    def errors(path: Path) -> Iterator[None]:
        """Raise a one-line :class:`InputError` for file errors in the block."""
        try:
            with quiet():
                yield
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from None
        except Tf.ErrorException as error:
            raise InputError(f"{path}: cannot be written ({' '.join(str(error.args[0]).split())})") from None

    # ---------------------------------------------------------------------------------------------------------------

    def lock(self) -> None:
        """Lock the files for this run; :meth:`close` or the end of the process unlocks them."""
        if self._lock >= 0:
            return
        path = self.root.with_name(f".{self.root.stem}.lock")
        with self.errors(self.root):
            path.parent.mkdir(parents=True, exist_ok=True)
            while self._lock < 0:
                self._lock = self._try_lock(path)
            for leftover in path.parent.glob(glob.escape(f".{self.root.stem}.tmp") + "?" * 8):
                shutil.rmtree(leftover, ignore_errors=True)  # of a run that was killed
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.root.stem}.tmp", dir=path.parent))

    def _try_lock(self, path: Path) -> int:
        """Lock a file; return its descriptor, -1 where its previous owner has removed the file meanwhile."""
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise InputError(f"{self.root}: another run is writing it") from None
        except OSError as error:
            if error.errno not in _UNLOCKABLE:
                raise
        if path.exists() and os.path.samestat(os.fstat(descriptor), path.lstat()):
            return descriptor
        os.close(descriptor)
        return -1

    def temporary(self, target: Path) -> Path:
        """Return the temporary path that :meth:`place` moves to ``target``; call :meth:`lock` first."""
        assert self._folder is not None, "lock() comes first"
        return self._folder / target.name

    def write(self, layer: Sdf.Layer, target: Path) -> None:
        """Write a layer to the temporary path of ``target``."""
        arguments = {"format": "usda"} if target.suffix == ".usd" else {}  # people read the short root layer
        if not layer.Export(str(self.temporary(target)), args=arguments):
            raise InputError(f"{target}: cannot be written")

    def place(self, target: Path) -> None:
        """Move a temporary file or folder to ``target``."""
        if target.is_dir() and not target.is_symlink():
            os.rename(target, self.temporary(target).with_suffix(".old"))
        os.replace(self.temporary(target), target)

    def close(self) -> None:
        """Remove temporary files, and unlock."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
        if self._lock >= 0:
            self.root.with_name(f".{self.root.stem}.lock").unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = -1

    # ---------------------------------------------------------------------------------------------------------------

    def save_checkpoint(self, run: dict[str, str], arrays: dict[str, np.ndarray]) -> None:
        """Write a checkpoint of a run with identity ``run``; if that fails, the earlier one stays."""
        header = {"format": _FORMAT, "run": run, "names": sorted(arrays)}
        with open(self.temporary(self.checkpoint), "wb") as file:
            np.savez(file, **{_HEADER: np.array(json.dumps(header)), **arrays})
        self.place(self.checkpoint)

    def load_checkpoint(self) -> tuple[dict[str, str], dict[str, np.ndarray]] | None:
        """Return the identity of the run and the arrays of its checkpoint, None where there is none."""
        if reason := irregular_file(self.checkpoint):  # a pipe would wait for ever
            raise InputError(reason)
        try:
            with open(self.checkpoint, "rb") as file, np.load(file, allow_pickle=False) as saved:
                arrays = dict(saved)
            header = json.loads(str(arrays.pop(_HEADER)))
        except FileNotFoundError:
            return None
        except (OSError, EOFError, ValueError, KeyError, RuntimeError, MemoryError, zipfile.BadZipFile) as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{self.checkpoint}: cannot be read ({message})") from None
        if not isinstance(header, dict) or header.get("format") != _FORMAT:
            raise InputError(f"{self.checkpoint}: cannot be resumed, another version of warpmag has written it")
        if header["names"] != sorted(arrays):
            raise InputError(f"{self.checkpoint}: cannot be read (some of it is missing)")
        return header["run"], arrays
