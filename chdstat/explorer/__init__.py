"""Explorer: a page in the browser on which a click on a pixel shows its distribution.

`explore` serves it. The modules, upstream first:

- `view`: what a page shows, as a value that fits into an address;
- `palette`: colours;
- `sources`, `images`: samples of a store or of a scene, and the image that is made of them;
- `estimators`, `statistics`: what is computed of a pixel or a region;
- `maps`: one number or label per pixel in the place of the image;
- `panels`, `tables`: what plots and tables show of a selection;
- `plots`, `page`: the Bokeh figures and the document around them;
- `shared`: state that all pages have in common, with the cache of images and maps;
- `exports`, `selection`: a selection as a file, and everything that is shown of it;
- `worker`: the selection of a page, computed in the thread of clicks;
- `session`, `server`: one page and its commands, and the server of all pages.
"""

from __future__ import annotations

from chdstat.explorer.server import DEFAULT_PORT, Explorer, explore

__all__ = ["DEFAULT_PORT", "Explorer", "explore"]
