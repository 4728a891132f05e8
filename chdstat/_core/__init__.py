"""Core: what every part of the library stands on."""

__all__: list[str] = []
