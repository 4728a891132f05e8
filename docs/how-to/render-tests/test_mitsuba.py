"""A scene of Mitsuba: a built-in name, an XML file, a dict, or a chdstat.Scene."""


def test_kitchen(same_light):
    same_light("kitchen/scene.xml", spp=64)
