"""Warp kernels of warpmag, in one folder per physical stage. Each folder imports only the folders before it.

| folder | content |
|---|---|
| shared | native code, CPU threads, vectors, reductions |
| material | magnetization curves |
| pairs | fields and forces of moments, summed over all pairs |
| fmm | the fast multipole method |
| applied | fields of coils, field maps and permanent bodies |
| cells | corrections between the cells of one body |
| eddy | eddy currents |
| induction | equilibrium of inducible moments |
| near_contact | corrections between balls that nearly touch |
| rigid, contacts | magnets on rigid bodies, contacts and joints |

The folder ``kernels/`` of the checkout is the package ``warpmag.kernels``. Under another name its modules would be
compiled and registered with Warp a second time.
"""

if __name__ != "warpmag.kernels":
    raise ImportError(f"import this package as 'warpmag.kernels', not as {__name__!r}")
