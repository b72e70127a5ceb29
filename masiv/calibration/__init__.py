"""How well the calibration of the cameras agrees with the silhouettes."""
