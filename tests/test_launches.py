"""Recorded launches write what launches of Warp write, whatever changes between them."""

import numpy as np
import pytest
import warp as wp

from warpmag.kernels.shared.launches import RecordedLaunches


@wp.struct
class Scale:
    factors: wp.array[float]
    sign: float


@wp.kernel(enable_backward=False)
def multiply(scale: Scale, offset: float, values: wp.array[float], products: wp.array[float]):
    i = wp.tid()
    products[i] = scale.sign * scale.factors[i] * values[i] + offset


@pytest.fixture
def arrays(device):
    rng = np.random.default_rng(3)
    return [wp.array(rng.normal(size=5), dtype=float, device=device) for _ in range(4)]


def test_arguments_that_change(device, arrays):
    a, b, c, out = arrays
    scale, launch = Scale(), RecordedLaunches()
    scale.factors, scale.sign = a, 1.0
    for values, sign, factors, offset in [(b, 1.0, a, 0.0), (c, 1.0, a, 0.0), (c, -2.0, b, 3.5), (b, -2.0, b, 3.5)]:
        scale.sign, scale.factors = sign, factors  # fields of the same struct
        launch(multiply, 5, [scale, offset, values], [out], device=device)
        expected = sign * factors.numpy() * values.numpy() + np.float32(offset)
        np.testing.assert_allclose(out.numpy(), expected, rtol=1e-6, atol=1e-6)


def test_another_output_and_another_dimension(device, arrays):
    a, b, c, out = arrays
    scale, launch = Scale(), RecordedLaunches()
    scale.factors, scale.sign = a, 1.0
    others = out.numpy()
    for dim, target in [(5, c), (2, out), (5, c), (0, out)]:
        launch(multiply, dim, inputs=[scale, 0.0, b], outputs=[target], device=device)
    products = a.numpy() * b.numpy()
    np.testing.assert_allclose(c.numpy(), products, rtol=1e-6)
    np.testing.assert_allclose(out.numpy(), [*products[:2], *others[2:]], rtol=1e-6)


def test_an_argument_of_another_type_is_refused(device, arrays):
    a, b, _, out = arrays
    scale, launch = Scale(), RecordedLaunches()
    scale.factors, scale.sign = a, 1.0
    launch(multiply, 5, [scale, 0.0, b], [out], device=device)
    with pytest.raises(RuntimeError, match="values"):
        launch(multiply, 5, [scale, 0.0, wp.zeros(5, dtype=int, device=device)], [out], device=device)
