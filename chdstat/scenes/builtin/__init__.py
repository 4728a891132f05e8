"""The built-in scenes, one module each: `chdstat.scenes.BUILTIN` lists them."""

__all__: list[str] = []
