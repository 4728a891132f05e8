"""Any program that writes EXR files and takes a seed."""

import subprocess

import chdstat as chd


def test_attic(same_light, tmp_path):
    def draw(seed):
        file = tmp_path / "pass.exr"
        render = ["./renderer", "attic.txt", "--spp", "1", "--seed", str(seed), "--out", file]
        subprocess.run(render, check=True)
        return chd.io.read_exr(file).image

    same_light(draw, spp=64)
