"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The modules, upstream first:

- `address`: what a page shows, as a value that fits into an address;
- `render_process`, `image_sources`: samples of a store or of a scene, and their image;
- `batch_estimates`: what estimators give of a pixel or a region;
- `tables`: the numbers of pixels and regions as text;
- `overlays`: the table of maps, one number or label per pixel over the image;
- `panels`: the table of plots, what they draw of a selection, and their Bokeh figures;
- `passes`: long work over the image, the latest request first;
- `workspace`: what all pages have in common, with the threads, and pixels that are worth a look;
- `selection`, `export`: all that is shown of a selection, and its files;
- `bokeh_document`: the Bokeh document of a page;
- `session`: one page and its commands;
- `server`: the server of all pages, and the notice until there is a page.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
