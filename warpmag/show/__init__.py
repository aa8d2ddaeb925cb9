"""Pictures, films, web pages and exports of finished stages, and magnets in Newton's viewers.

| module | content |
|---|---|
| ``ray_tracing``, ``films`` | frames drawn by ray tracing on any device; files of pictures and films |
| ``blender``, ``blender_script`` | finished pictures by Blender's path tracer |
| ``export`` | exports for renderers and web pages, and arrays of numbers |
| ``renderer_stage`` | a stage for renderers, of ``meshes``, ``materials``, ``instances`` and ``magnet_overlays`` |
| ``web_page``, ``glb`` | one web page of such a stage |
| ``viewers`` | magnets in Newton's viewers |

Only the command, the examples, ``scenes_usd`` and the public names of warpmag import this package. May import
``declarations``, ``shapes``, ``moments``, ``usd``, ``usd/read``, ``usd/write``, ``engine/magnets`` and
``engine/stepping``.
"""
