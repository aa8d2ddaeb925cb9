"""USD in and out: the schemas of magnets, the reader, the writer of a run's cache and the checker of stages.

The only part of warpmag that imports ``pxr``. Importing it registers the schemas of warpmag and those of Newton; do so
before the first stage is opened in a process, for USD takes no new schemas afterwards (warpmag reads its own
attributes right even then).
"""

from warpmag.usd.schemas import author_magnet, author_settings, collider_magnet, magnet_of, shape_axis  # isort: skip  (registers the schemas first)
from warpmag.usd.paths import usable_path
from warpmag.usd.read.alike import MOMENTS, AlikeBalls, BallFrames
from warpmag.usd.read.check import StageReport, check, inspect
from warpmag.usd.read.clock import StageClock, stage_clock
from warpmag.usd.read.coils import author_coil, author_field_map, is_source, placed_sources, world_matrix_at
from warpmag.usd.read.densities import give_densities, has_volume
from warpmag.usd.read.guard import readable, refusals
from warpmag.usd.read.instancers import complete_instances
from warpmag.usd.read.joints import GroundedJoint, enabled_joints, prepare_joints
from warpmag.usd.read.motion import Recording, read_recording
from warpmag.usd.read.playback import Playback
from warpmag.usd.read.reader import (
    StageContents,
    describe,
    first_camera,
    hold,
    open_apart,
    open_motion,
    open_stage,
    read_magnets,
    survey,
)
from warpmag.usd.read.swarms import Swarm, swarms_of
from warpmag.usd.values import Finding
from warpmag.usd.write.writer import CacheWriter, Earlier

__all__ = [
    "MOMENTS",
    "AlikeBalls",
    "BallFrames",
    "CacheWriter",
    "Earlier",
    "Finding",
    "GroundedJoint",
    "Playback",
    "Recording",
    "StageClock",
    "StageContents",
    "StageReport",
    "Swarm",
    "author_coil",
    "author_field_map",
    "author_magnet",
    "author_settings",
    "check",
    "collider_magnet",
    "complete_instances",
    "describe",
    "enabled_joints",
    "first_camera",
    "give_densities",
    "has_volume",
    "hold",
    "inspect",
    "is_source",
    "magnet_of",
    "open_apart",
    "open_motion",
    "open_stage",
    "placed_sources",
    "prepare_joints",
    "read_magnets",
    "read_recording",
    "readable",
    "refusals",
    "shape_axis",
    "stage_clock",
    "survey",
    "swarms_of",
    "usable_path",
    "world_matrix_at",
]
