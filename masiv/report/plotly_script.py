"""plotly.js, as the Python package plotly brings it, in a form that a page can hold.

It draws the charts and the 3D view. Compressed, it takes 2 MB of a page in place of 5. Browsers unpack it themselves
(DecompressionStream: Chromium 80, Firefox 113, Safari 16.4).
"""

from __future__ import annotations

import base64
import gzip
from functools import cache


@cache
def packed_script() -> str:
    """The script, gzip, base64."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode("utf-8"), mtime=0)).decode("ascii")
