"""The families of scenes by name."""

from collections.abc import Callable

import numpy as np

from cgsf.synthetic.scene import Scene
from cgsf.synthetic.street import street
from cgsf.synthetic.textures import TextureSource
from cgsf.synthetic.things import things

#: name -> function (generator, textures, height, width) -> scene
FAMILIES: dict[str, Callable[[np.random.Generator, TextureSource, int, int], Scene]] = {
    "street": street,
    "things": things,
}
