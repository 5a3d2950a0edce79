"""Stereo video with exact truth, made on the fly: `make_sample` and `make_video`. See docs/synthetic.md."""

from cgsf.synthetic.families import FAMILIES
from cgsf.synthetic.render import RenderConfig, make_sample, make_scene, make_video

__all__ = ["FAMILIES", "RenderConfig", "make_sample", "make_scene", "make_video"]
