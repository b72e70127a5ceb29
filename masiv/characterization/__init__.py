"""A constitutive law in the terms of a material tester: moduli, yield, viscosity, nearest classical family."""
