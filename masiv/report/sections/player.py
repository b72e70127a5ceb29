"""The motion as a section of the report: a time slider, the 3D view and the view through the cameras."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from masiv.report.charts import Chart
from masiv.report.motion_view import Motion, motion_data
from masiv.report.page import Page
from masiv.scene.scene import Ground

PLAYER = """<div class="player"><button id="play" type="button">Play</button>
<input id="time" type="range" min="0" max="0" value="0" aria-label="time"><output id="now" for="time"></output></div>
<div class="controls"><select id="motion" aria-label="recording" hidden></select></div>"""
SPACE = """<figure><h4>In space</h4><div class="controls"><span id="show">
<button type="button" value="both" aria-pressed="true">both</button>
<button type="button" value="observed" aria-pressed="false">observed</button>
<button type="button" value="simulated" aria-pressed="false">simulated</button></span> <span id="look">
<button type="button" value="corner" aria-pressed="true">corner</button>
<button type="button" value="front" aria-pressed="false">front</button>
<button type="button" value="side" aria-pressed="false">side</button>
<button type="button" value="above" aria-pressed="false">above</button></span></div>
<div id="space" class="space"></div><figcaption>{caption}</figcaption></figure>"""
CAMERAS = """<figure><h4>Through the cameras</h4><div class="controls">
<select id="camera" aria-label="camera"></select> <span id="against">
<button type="button" value="twin" aria-pressed="true">twin</button>
<button type="button" value="reconstruction" aria-pressed="false">reconstruction</button></span></div>
<div class="wipe"><canvas id="pictures" role="img" aria-label="observed and simulated picture"></canvas>
<span class="left">observed</span><span class="right" id="right-name">twin</span></div>
<input id="wipe" type="range" min="0" max="1000" value="500" aria-label="border between the pictures">
<figcaption>{caption}</figcaption></figure>"""


def player_section(
    page: Page,
    motions: Sequence[Motion],
    up: np.ndarray,
    ground: Ground | None = None,
    cameras: Sequence[Mapping[str, Any]] = (),
    in_space: bool = True,
    beside: Chart | None = None,
) -> None:
    """cameras: as ``camera_view.camera_data`` gives them, of the instants of the motions. in_space: whether places are
    known along three axes. beside: a chart to be seen with the views."""
    page.heading("See it move")
    page.note(
        "The slider moves everything on this page: both views, and the cursor in each plot over time. Play is four "
        "times slower than real, or slower still for short frames."
    )
    page.script(PLAYER, motion=motion_data(motions, up, ground))
    views = []
    if in_space:
        views.append(SPACE.format(caption=html.escape(_caption(motions[0], page.data["motion"]["motions"][0]))))
    if cameras:
        page.script("", cameras=list(cameras))
        views.append(
            CAMERAS.format(
                caption="Drag across the picture: observed on the left, the other on the right. The twin is simulated "
                "from frame 0 on and is never corrected later; the reconstruction follows the pictures and ends with "
                "the fitted frames. Object on black."
            )
        )
    if beside is not None:
        views.append(page.chart_figure(beside))
    page.script(f'<div class="views">{"".join(views)}</div>')


def _caption(motion: Motion, packed: Mapping[str, Any]) -> str:
    shown = f"{packed['points']} of {packed['of']} points" if packed["points"] < packed["of"] else "All points"
    return (
        f"Drag to turn, scroll to zoom. {shown}. Grey: observed. Colour: simulated, by the distance to where the same "
        "point was observed; grey if it was not. The scale ends at the largest hundredth of all errors."
    )
