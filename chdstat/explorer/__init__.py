"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The parts, upstream first: `view` is what a page shows, as a value, `address`
reads it back; `sources` and `live` are where samples come from; `measured` and `judged` what is
computed of them; `traces` and `tables` what panels and tables show; `images` and `maps` the
image and what takes its place; `plots` and `page` are the Bokeh document, `inquiry` asks for what
it shows, `session` is one person before it, `server` the rest.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
