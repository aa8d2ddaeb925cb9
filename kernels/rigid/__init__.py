"""Coupling of magnets to rigid bodies: moments and sources on bodies, motion by keys, and the control of substeps.

| module | contents |
|---|---|
| newton_views | structs of Newton's arrays of bodies and contacts |
| bodies | positions and moments of magnets from their bodies, wrenches on the bodies |
| distant | bodies of iron with few moments: the choice by worlds, and the cells |
| sources | frames and motion of coils and field maps, wrenches on their bodies; readings at sites |
| keys, keyed_poses | time-sampled values, and poses of kinematic bodies that follow them |
| monitor | largest motion, penetration, buffer use and induction error of a substep |
| stepping | state machine of a step: length of substeps, attempts, log |
| worlds | masks of worlds that start again, and rows of arrays that return to earlier values |

May import ``shared`` and ``pairs``. Contacts and joints are in ``contacts``.
"""
