"""Every experiment of Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation", run again.

``python -m bench.paper fig7|fig8|fig9|fig10|uniqueness|stability|table1|all [--device cpu|cuda:0] [--small] [-o DIR]``

| experiment | module | what the paper says |
|---|---|---|
| fig7 | ``fig7`` | crystal balls around a bar magnet before and after induction, three methods |
| fig8 | ``fig8`` | magnetization error over iterations, three methods, two strengths of the bar |
| fig9 | ``fig9`` | iterations over time step and field strength, three methods |
| fig10 | ``fig10`` | force field over the cross-section of a spherical magnet, both force laws |
| uniqueness | ``uniqueness`` | the methods that converge agree (section 6.3) |
| stability | ``stability`` | what becomes of the dynamic scenes, with both force laws and kim2018 |
| table1 | ``table1`` | times per step of induction, forces and rigid bodies |

Each writes PNGs and JSON lines (``EXPERIMENT.jsonl``, with machine, commit and device) and its section of
``report.md``. Constants that the paper leaves open are chosen in the module that needs them, where the second choice
stands beside them.
"""
