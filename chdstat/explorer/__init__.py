"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The modules, upstream first:

- `view`: what a page shows, as a value that fits into an address;
- `startup`: images as a browser shows them, and the notice until there is one;
- `render_process`, `sources`: samples of a store or of a scene, and their image;
- `estimators`, `statistics`, `tables`: what is computed of a pixel or a region, and how it is told;
- `maps`: one number or label per pixel over the image;
- `plots`, `panels`: the lines and areas that plots show of a selection, and their figures;
- `shared`: state that all pages have in common, with the threads;
- `selection`: all that is shown of a selection, and its export as a file;
- `page`: the Bokeh document of a page;
- `session`: one page and its commands;
- `server`: the server of all pages.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
