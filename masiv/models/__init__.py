"""Forward models: parameters -> positions at the points and times of an observation."""
