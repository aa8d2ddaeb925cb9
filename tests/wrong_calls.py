"""Wrong calls of ``h_field`` of tensors or JAX arrays, and the whole lines of their errors."""

WRONG = {
    "shape": (lambda h_field, x, m: h_field(x, m[:, :2]), r"moments: shape must be \[3, 3\], got \[3, 2\]"),
    "none": (lambda h_field, x, m: h_field(x, None), "moments: must be real numbers, got None"),
    "text": (lambda h_field, x, m: h_field(x, m, radii="1"), "radii: must be real numbers, got '1'"),
    "places": (lambda h_field, x, m: h_field(x, m, x[0]), r"targets: shape must be \[n, 3\], got \[3\]"),
    "owner": (lambda h_field, x, m: h_field(x, m, target_radii=0.1), "target_radii: only with targets"),
    "complex": (lambda h_field, x, m: h_field(x, 1j * m), "moments: must be real numbers, got .*complex128"),
}
