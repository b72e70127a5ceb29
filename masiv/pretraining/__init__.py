"""Neural laws trained on simulated classical materials: what ``identify`` starts from."""
