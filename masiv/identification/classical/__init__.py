"""Classical laws: few parameters, finite differences, Gauss-Newton."""
