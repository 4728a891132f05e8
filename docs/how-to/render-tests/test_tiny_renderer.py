"""The light of the tiny renderer stays what it is."""

from tiny_renderer import draw


def test_room(same_light):
    same_light(draw, spp=256)
