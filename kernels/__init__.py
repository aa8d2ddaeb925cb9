"""Warp kernels of warpmag: pair laws, all-pairs loops, induction and forces.

The folder ``kernels/`` of the checkout is the package ``warpmag.kernels``. Imported under another name its modules
would be compiled, and their functions registered with Warp, a second time.
"""

if __name__ != "warpmag.kernels":
    raise ImportError(f"import this package as 'warpmag.kernels', not as {__name__!r}")
