"""A page in the browser to look into a run, and to simulate its twin again while one looks.

``subject``: what there is to show; ``variation``: what is asked of the simulation; ``simulations``: the process that
simulates; ``shown``: what is on the page now, apart from any widget; ``nodes``, ``controls``: the page's 3D scene and
its widgets, by viser; ``page``: all of them together.
"""
