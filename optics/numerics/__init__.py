"""Arrays and kernels: backends, fixed sums, quadrature, immutable maps."""
