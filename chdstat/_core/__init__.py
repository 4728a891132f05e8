"""Core: what all parts of the library build on."""

__all__: list[str] = []
