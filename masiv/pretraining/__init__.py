"""Neural laws taught from simulated classical materials: what ``identify`` starts from."""
