"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The modules, upstream first:

- `view`: what a page shows, as a value that fits into an address;
- `sources`: samples of a store or of a scene, and the image that is made of them;
- `estimators`, `statistics`: what is computed of a pixel or a region, and the tables of it;
- `maps`: one number or label per pixel in the place of the image;
- `panels`: the lines and areas that plots show of a selection;
- `shared`: state that all pages have in common, with the threads;
- `selection`: all that is shown of a selection, and its export as a file;
- `page`: the Bokeh document of a page;
- `session`, `server`: one page and its commands, and the server of all pages.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
