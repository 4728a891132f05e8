"""What the built-in scenes are furnished with: shapes, textures, lights, and whole rooms."""

__all__: list[str] = []
