"""Neural laws: gradients by the adjoint of the rollout, Adam."""
