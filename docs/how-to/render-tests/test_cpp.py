"""A renderer in C++ that writes its samples with chdstat_writer.h."""

import subprocess

import chdstat as chd


def test_box(same_light, tmp_path):
    def draw(seed):
        file = tmp_path / "box.chds"
        subprocess.run(["./tracer", file, "48", "48", "64", str(seed)], check=True)
        return chd.io.read(file).read()  # 64 samples of each pixel

    same_light(draw, spp=256)
