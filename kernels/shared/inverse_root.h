// Inverse square root of positive numbers.
#pragma once

namespace warpmag {

// 2/√c. On AVX-512 Newton's iteration refines an estimate of relative error 2⁻¹⁴, in 4 operations. A square root and a
// division of a vector would occupy the divider for 22 cycles (Sapphire Rapids; 16 on Zen 4), as long as the rest of a
// pair. On AVX2 they take half of that and overlap with the sums. The estimate of AVX2 is good to 2⁻¹² only, so
// that Newton's steps would cost at least as much.
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Real twice_inverse_root(Real c) { return 2 * rsqrt(c); }
#else
template <class N> inline N twice_inverse_root(N c) {
#if defined(__AVX512F__)
    if constexpr (sizeof(N) == 64) {
        N y;
        if constexpr (sizeof(N) / sizeof(Real) == 16) {
            y = __builtin_ia32_rsqrt14ps512_mask(c, c, (unsigned short)-1);
        } else {
            y = __builtin_ia32_rsqrt14pd512_mask(c, c, (unsigned char)-1);
            y *= Real(1.5) - Real(0.5) * c * (y * y);
        }
        return y * (Real(3) - c * (y * y));
    }
#endif
    return Real(2) / __builtin_elementwise_sqrt(c);
}
#endif
}
