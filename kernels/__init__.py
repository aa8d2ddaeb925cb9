"""Warp kernels of warpmag, in rooms by physical stage, each of which imports only rooms before it.

``shared``: what all use. ``material``: magnetization curves. ``pairs``: fields and forces of moments. ``induction``:
their equilibrium. ``near_contact``: what dipoles lack between balls that nearly touch. ``rigid``: bodies and steps.

The folder ``kernels/`` of the checkout is the package ``warpmag.kernels``. Imported under another name its modules
would be compiled, and their functions registered with Warp, a second time.
"""

if __name__ != "warpmag.kernels":
    raise ImportError(f"import this package as 'warpmag.kernels', not as {__name__!r}")
