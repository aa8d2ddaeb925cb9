"""How many float32 multiply-adds a core starts in a second: the limit that a CPU's pair loop is held against."""

import time

import numpy as np
import warp as wp

_CHAINS = 12
"""Independent chains: more than the latency times the units of any core."""
_LINKS = 20000
_TRIALS = 50


@wp.func_native(f"""
    #if defined(__AVX512F__)
    constexpr int LANES = 16;
    #elif defined(__AVX__)
    constexpr int LANES = 8;
    #else
    constexpr int LANES = 4;
    #endif
    typedef float VECTOR __attribute__((ext_vector_type(LANES)));
    {{
    #pragma clang fp contract(fast)
    VECTOR x[{_CHAINS}];
    for (int k = 0; k < {_CHAINS}; ++k) x[k] = k;
    #pragma clang loop unroll(disable)
    for (int i = 0; i < {_LINKS}; ++i) {{
        #pragma clang loop unroll(full)
        for (int k = 0; k < {_CHAINS}; ++k) x[k] = x[k] * 0.999f + 0.001f;
    }}
    float sum = 0;
    for (int k = 0; k < {_CHAINS}; ++k) sum += x[k][0];
    sum_out.data[0] = sum;
    sum_out.data[1] = LANES;
    }}
""")
def multiply_add(sum_out: wp.array[float]): ...  # noqa: D103


@wp.kernel(
    module="unique",
    enable_backward=False,
    module_options={"cpu_compiler_flags": "-march=native -mprefer-vector-width=512"},
)
def run_multiply_add(sum_out: wp.array[float]):
    """Run all chains."""
    multiply_add(sum_out)


def measure(device) -> float:
    """Multiply-adds a second of one core, the best of some trials."""
    out = wp.zeros(2, dtype=float, device=device)
    command = wp.launch(run_multiply_add, dim=1, outputs=[out], device=device, record_cmd=True)
    times = []
    for _ in range(_TRIALS):
        began = time.perf_counter()
        command.launch()
        times.append(time.perf_counter() - began)
    return float(_CHAINS * _LINKS * out.numpy()[1] / np.min(times))
