"""The experiments of Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation", repeated.

``python -m bench.paper fig7|fig8|fig9|fig10|uniqueness|stability|table1|all [--device cpu|cuda:0] [--small] [-o DIR]``

| experiment | module | content |
|---|---|---|
| fig7 | ``fig7`` | crystal balls around a bar magnet before and after induction, three methods |
| fig8 | ``fig8`` | magnetization error over iterations, three methods, two strengths of the bar |
| fig9 | ``fig9`` | iterations over time step and field strength, three methods |
| fig10 | ``fig10`` | force field over the cross-section of a spherical magnet, both force laws |
| uniqueness | ``uniqueness`` | agreement of the methods that converge (section 6.3) |
| stability | ``stability`` | final states of the dynamic scenes, with both force laws and kim2018 |
| table1 | ``table1`` | times per step of induction, forces and rigid bodies |

Each writes PNGs and JSON lines (``EXPERIMENT.jsonl``, with machine, commit and device) and its section of
``report.md``. Constants that the paper does not state are chosen in the module that needs them, next to a second
choice.
"""
