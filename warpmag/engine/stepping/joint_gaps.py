"""Finds joints of a model whose ends are apart where it starts: they pull, whatever is between them."""

from typing import Any

import newton
import numpy as np

from warpmag.declarations.checks import joint_ends_apart, joint_gap_message
from warpmag.engine.pile_xpbd.joints import are_pins


def strained_joints(model: newton.Model) -> dict[str, float]:
    """Return how far the ends of joints are apart where a model starts [m], in ways that the joint does not leave free.

    Newton places no bodies by their joints; ``newton.eval_fk`` does that, or ``xform`` where bodies are added.

    Returns:
        The distances of those that are apart, by the label of the joint.
    """
    if not model.joint_count:
        return {}
    poses = np.append(_host(model.body_q), [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], axis=0)  # body -1 is the world
    parents, frames = poses[_host(model.joint_parent)], _host(model.joint_X_p)
    one = _placed(parents, frames[:, :3])
    gaps = one - _placed(poses[_host(model.joint_child)], _host(model.joint_X_c)[:, :3])
    slides = _host(model.joint_type) == newton.JointType.PRISMATIC
    axes = _host(model.joint_axis)[_host(model.joint_qd_start)[:-1][slides]]
    axes = _turned(parents[slides], _turned(frames[slides], axes))
    gaps[slides] -= axes * (axes * gaps[slides]).sum(axis=1, keepdims=True)
    lengths = np.linalg.norm(gaps, axis=1)
    found = (are_pins(model) | slides) & _host(model.joint_enabled)
    found &= joint_ends_apart(lengths, np.linalg.norm(one, axis=1))
    return {model.joint_label[joint]: float(lengths[joint]) for joint in np.flatnonzero(found)}


def _placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points of frames in the world, shape [n, 3], of poses of shape [n, 7]."""
    return poses[:, :3] + _turned(poses, points)


def _turned(poses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors of frames in the world, shape [n, 3], of poses of shape [n, 7]."""
    axes = poses[:, 3:6]
    return vectors + 2.0 * np.cross(axes, np.cross(axes, vectors) + poses[:, 6:] * vectors)


def _host(array: Any) -> np.ndarray:  # Newton's declarations hide what is an array
    return array.numpy()


def strain_warnings(strained: dict[str, float]) -> list[str]:
    """Return what a user should know of joints whose ends are so far apart at the start [m], by label; a line at most.

    Stages have findings of their own, of their prims.
    """
    if not strained:
        return []
    label, more = next(iter(strained)), len(strained) - 1
    whose = f"{label} and {more} other joints: their ends are up to" if more else f"{label}: its ends are"
    return [f"{whose} {joint_gap_message(max(strained.values()))}; place the bodies, with newton.eval_fk say"]
