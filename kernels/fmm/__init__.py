"""Fast multipole method: near pairs summed directly, far fields by expansions of an octree's boxes.

May import ``shared``, ``material`` and ``pairs``.

| module | content |
|---|---|
| octree | occupied boxes of all levels, and moments sorted by leaf |
| near | direct sums over moments in neighboring leaves (P2P) |
| expansions | multipoles (P2M, M2M), local expansions (L2L), fields from them (L2P) |
| translate | multipoles to local expansions (M2L) |
| sharing | boxes of one of several processes |
| evaluation | the whole sum, and its error |
"""
