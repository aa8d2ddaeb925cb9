"""Magnetic equilibrium of inducible moments: θ flow and baseline dynamics (Eqs. 5, 6, 8, 9, 11), convergence (Eq. 12).

May import ``shared``, ``material``, ``pairs`` and ``cells``.

| module | content |
|---|---|
| solve_state | state of a solve for every dynamics, worlds, convergence |
| theta_flow | accelerated θ flow, the default dynamics |
| body_products | fields and steps of bodies of cells as a whole |
| submagnetization | baseline dynamics by pairs of submagnetizations |
| energy | energy in equilibrium |
| tangent | linear solve at an equilibrium, for gradients |
| cell_turns | gradients with respect to rotations of bodies of cells |
| `theta_step.h`, `anderson.h` | choice of a world's next step, and its mixture of iterates |
"""
