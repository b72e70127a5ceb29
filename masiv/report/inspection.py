"""What was read of a scene, as numbers, as text and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from masiv.calibration.consistency import odd_camera, silhouette_consistency
from masiv.hull.first_frame import first_frame_problems
from masiv.hull.mask_quality import mask_quality
from masiv.observations.identity import identity
from masiv.report.contact_sheet import write_contact_sheet
from masiv.scene.scene import Scene
from masiv.scene.summary import as_text, summarise
from masiv.tracks.summary import summarise_tracks, tracks_as_text, write_tracks_picture
from masiv.tracks.tracks import Tracks


def inspection(read: Scene | Tracks, picture: Path) -> tuple[dict[str, Any], str]:
    """Summary and text of what was read; draws it to ``picture`` (PNG)."""
    if isinstance(read, Tracks):
        write_tracks_picture(read, picture)
        summary = {**summarise_tracks(read), "picture": str(picture)}
        return summary, tracks_as_text(summary)
    agreement = silhouette_consistency(read)
    summary = {**summarise(read), **identity(read), "picture": str(picture)}
    for view, error in zip(agreement.views, agreement.pixels, strict=True):
        summary["cameras"][view]["consistency_px"] = float(error) if np.isfinite(error) else None
    quality = mask_quality(read)
    for view, agrees, doubt in zip(quality.views, quality.agreement, quality.doubt, strict=True):
        summary["cameras"][view]["mask_agreement"] = float(agrees) if np.isfinite(agrees) else None
        summary["cameras"][view]["mask_doubt"] = float(doubt) if np.isfinite(doubt) else None
    summary["problems"] += [*first_frame_problems(read), *quality.problems()]
    odd = odd_camera(read, agreement)
    summary["problems"] += [] if odd is None else [odd]
    write_contact_sheet(
        read, picture, {v: f"{e:.1f} px" for v, e in zip(agreement.views, agreement.pixels, strict=True)}
    )
    return summary, as_text(summary)
