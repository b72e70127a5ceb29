"""``masiv import``: a scene from own footage. (``import`` is a word of Python, hence the names.)"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    ArchOption,
    ConfigOption,
    JsonOption,
    PresetOption,
    SeedOption,
    SetOption,
    numbers,
    pairs,
    vector,
)

_Several = list[str] | None


def import_footage(
    footage: Annotated[
        Path,
        typer.Argument(help="Folder with one video, or one folder of pictures, a camera.", show_default=False),
    ],
    calibration: Annotated[
        Path,
        typer.Option(
            help="COLMAP folder (text or binary), nerfstudio transforms.json, or .toml of OpenCV, Anipose, Pose2Sim.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the new scene.", show_default=False)],
    camera: Annotated[
        _Several,
        typer.Option(
            metavar="NAME=RECORDING",
            help="Camera NAME of the calibration made RECORDING (in FOOTAGE); repeat. [default: all, by their names]",
        ),
    ] = None,
    sync: Annotated[
        str | None,
        typer.Option(
            help="What the cameras share: start (all begin together), clock (their times), flash, clap. [default: "
            "start; clock with --times]"
        ),
    ] = None,
    offset: Annotated[
        _Several,
        typer.Option(
            metavar="NAME=SECONDS", help="The common time 0 is this much later in the recording NAME; repeat."
        ),
    ] = None,
    times: Annotated[
        str,
        typer.Option(
            help="Times of frames: container, names (the last number in a picture's name), or a folder with "
            "NAME.txt, a frame a line."
        ),
    ] = "container",
    time_unit: Annotated[str, typer.Option(help="Of --times: s, ms, us, ns or frames.")] = "s",
    recorded_fps: Annotated[
        _Several,
        typer.Option(
            metavar="[NAME=]FPS", help="Rate of recording: for folders of pictures, and slow motion; may be repeated."
        ),
    ] = None,
    start: Annotated[float | None, typer.Option(help="First frame [s, common time].")] = None,
    end: Annotated[float | None, typer.Option(help="Last frame [s, common time].")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second. [default: those of the slowest camera]")] = None,
    every: Annotated[int, typer.Option(help="Keep every N-th frame.")] = 1,
    downscale: Annotated[float, typer.Option(help="Divide both sides of the pictures.")] = 1.0,
    jpeg: Annotated[int | None, typer.Option(help="Write JPEG of this quality. [default: PNG]")] = None,
    plates: Annotated[
        Path | None, typer.Option(help="Folder: the empty scene, a picture or clip NAME a camera.")
    ] = None,
    plate_seconds: Annotated[
        str | None, typer.Option(metavar="FROM,TO", help="The recordings show the empty scene then [s, common time].")
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder: a video or folder NAME a camera, white on the object, as the footage.")
    ] = None,
    chroma: Annotated[
        str | None, typer.Option(metavar="HUE-HUE", help="The background has these hues [degrees]: 90-150 is green.")
    ] = None,
    segmenter: Annotated[
        Path | None, typer.Option(help="Masks by SAM 2: folder of its weights (pip install 'masiv[segment]').")
    ] = None,
    box: Annotated[
        _Several,
        typer.Option(metavar="NAME=X0,Y0,X1,Y1", help="Object in the first picture, for --segmenter; repeat."),
    ] = None,
    scale: Annotated[float | None, typer.Option(help="Metres of one unit of the calibration.")] = None,
    baseline: Annotated[
        str | None, typer.Option(metavar="NAME,NAME=METRES", help="Distance of the lenses of two cameras.")
    ] = None,
    landmarks: Annotated[
        Path | None, typer.Option(help="YAML: points in pixels, with distances, ground, up (docs/import.md).")
    ] = None,
    board: Annotated[Path | None, typer.Option(help="Folder: checkerboard on the ground, NAME.png a camera.")] = None,
    board_size: Annotated[
        str | None, typer.Option(metavar="NxMxMETRES", help="Inner corners and edge of a square: 9x6x0.025.")
    ] = None,
    up: Annotated[str | None, typer.Option(help="Up axis of the calibration: x, -y, … or three numbers.")] = None,
    ground: Annotated[str | None, typer.Option(help="Height of the ground along the up axis [m], or none.")] = None,
    density: Annotated[float | None, typer.Option(help="Of the object [kg/m³]. [default: 1000]")] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Make a scene from videos or pictures of several cameras and their calibration.

    Example: `masiv import videos --calibration calibration.toml --sync flash --plates empty --out SCENE`
    """
    from masiv.config import load_config
    from masiv.footage.board import parse_board
    from masiv.footage.empty_scene import parse_chroma
    from masiv.footage.make_scene import make_scene
    from masiv.footage.request import ImportRequest

    from .console import progress_bar

    load_config(preset, config, assignments=assignments or (), seed=seed, arch=arch)  # no setting acts; all are checked
    rates = {name: numbers(value, "--recorded-fps", 1)[0] for name, value in pairs(recorded_fps, "--recorded-fps", "")}
    boxes = {name: numbers(value, "--box", 4) for name, value in pairs(box, "--box")}
    line = None
    if baseline is not None:
        ((names, length),) = pairs([baseline], "--baseline")
        one, _, other = names.partition(",")
        line = one.strip(), other.strip(), numbers(length, "--baseline", 1)[0]
    request = ImportRequest(
        footage=footage,
        calibration=calibration,
        cameras=dict(pairs(camera, "--camera")),
        times=times,
        time_unit=time_unit,
        recorded_fps=rates,
        sync=sync or ("start" if times == "container" else "clock"),
        offsets={name: numbers(value, "--offset", 1)[0] for name, value in pairs(offset, "--offset")},
        fps=fps,
        start=start,
        end=end,
        every=every,
        downscale=downscale,
        jpeg=jpeg,
        plates=plates,
        plate_seconds=None if plate_seconds is None else numbers(plate_seconds, "--plate-seconds", 2),  # type: ignore[arg-type]
        masks=masks,
        chroma=None if chroma is None else parse_chroma(chroma),
        segmenter=segmenter,
        boxes=boxes,  # type: ignore[arg-type]
        scale=scale,
        baseline=line,
        landmarks=landmarks,
        board=board,
        board_size=None if board_size is None else parse_board(board_size),
        up=vector(up, "--up") if up is not None and "," in up else up,
        ground=ground if ground in (None, "none") else numbers(ground, "--ground", 1)[0],
        density=density,
    )
    with progress_bar() as progress:
        data = make_scene(request, out, progress=progress)
    return data, _as_text(data)


def _as_text(data: dict[str, Any]) -> str:
    lines = [f"{data['scene']}: {data['frames']} frames at {data['fps']:.6g} fps, {len(data['cameras'])} cameras"]
    for camera in data["cameras"]:
        lines.append(
            f"  {camera['name']:10s} {camera['width_px']}×{camera['height_px']}  {camera['pictures']} pictures; common "
            f"time 0 at {camera['clock_zero_s']:.4f} s; {camera['late_mean_ms']:+.2f} ms from the frames"
        )
    lines += ["problems " + ("none" if not data["problems"] else ""), *(f"  - {p}" for p in data["problems"])]
    return "\n".join([*lines, f"masiv inspect {data['scene']} shows it"])
