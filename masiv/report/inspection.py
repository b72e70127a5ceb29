"""What was read of a scene, as numbers, as text and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    write_contact_sheet(read, picture)
    summary = {**summarise(read), **identity(read), "picture": str(picture)}
    return summary, as_text(summary)
