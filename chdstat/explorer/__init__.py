"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The modules, upstream first:

- `view`: what a page shows, as a value that fits into an address;
- `sources`, `render_process`, `scene_source`: samples of a store or of a scene, and their image;
- `suggestions`: pixels that are worth a first look;
- `estimators`, `statistics`, `tables`: what is computed of a pixel or a region, and how it is told;
- `tones`, `maps`: images on the screen, and one number or label per pixel over them;
- `traces`, `panels`: the lines and areas that plots show of a selection;
- `shared`: state that all pages have in common, with the threads;
- `selection`, `exports`: all that is shown of a selection, and its export as a file;
- `plots`, `help`, `page`: the Bokeh document of a page;
- `session`: one page and its commands;
- `startup`, `server`: the notice until there is an image, and the server of all pages.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
