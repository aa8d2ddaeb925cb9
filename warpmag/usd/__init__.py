"""Reads and writes USD: schemas of magnets, stages and their errors, and the cache of a run.

Only this folder and ``show`` import ``pxr``. Importing this package registers the schemas of warpmag and Newton. Import
it before a process opens the first stage, because USD takes no new schemas afterwards. If USD does not know the
schemas, warpmag still reads its own attributes correctly. May import ``declarations``.
"""

from warpmag.usd.schemas import author_magnet, author_settings, collider_magnet, magnet_of, shape_axis  # isort: skip  (registers the schemas first)
from warpmag.usd.paths import usable_path
from warpmag.usd.read.ball_instancers import BallInstancer, ball_instancers
from warpmag.usd.read.check import StageReport, check, inspect
from warpmag.usd.read.clock import StageClock, stage_clock
from warpmag.usd.read.coils import author_coil, author_field_map, is_source, placed_sources, world_matrix_at
from warpmag.usd.read.concave_faces import triangulate_concave_faces
from warpmag.usd.read.identical_balls import MOMENTS_PRIMVAR, BallFrames, IdenticalBalls
from warpmag.usd.read.input_errors import newton_errors, usd_errors
from warpmag.usd.read.instancers import complete_instances
from warpmag.usd.read.joints import GroundedJoint, enabled_joint_paths, prepare_joints
from warpmag.usd.read.materials import give_densities
from warpmag.usd.read.opening import describe, freeze, open_animated, open_deferred, open_stage, perspective_cameras
from warpmag.usd.read.prims import has_volume
from warpmag.usd.read.recording import Playback, Recording, read_recording
from warpmag.usd.read.survey import StageContents, read_magnets, survey
from warpmag.usd.values import Finding, quiet
from warpmag.usd.write.model_joints import StageDrive, StageJoint
from warpmag.usd.write.model_stage import ModelStage, StageBody, StageShape
from warpmag.usd.write.writer import CacheWriter, PreviousRun

__all__ = [
    "MOMENTS_PRIMVAR", "BallFrames", "BallInstancer", "CacheWriter", "Finding", "GroundedJoint", "IdenticalBalls",
    "ModelStage", "Playback", "PreviousRun", "Recording", "StageBody", "StageClock", "StageContents", "StageDrive",
    "StageJoint", "StageReport", "StageShape", "author_coil",
    "author_field_map", "author_magnet", "author_settings", "ball_instancers", "check", "collider_magnet",
    "complete_instances", "describe", "enabled_joint_paths", "freeze", "give_densities", "has_volume", "inspect",
    "is_source", "magnet_of", "newton_errors", "open_animated", "open_deferred", "open_stage", "perspective_cameras",
    "placed_sources", "prepare_joints", "quiet", "read_magnets", "read_recording", "shape_axis", "stage_clock",
    "survey", "triangulate_concave_faces", "usable_path", "usd_errors", "world_matrix_at",
]  # fmt: skip
