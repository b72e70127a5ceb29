"""Boundary conditions of a scene that act as effects do. No search looks for them: they are declared."""
