"""KITTI Stereo and Flow 2012 (Geiger, Lenz and Urtasun, CVPR 2012): 194 training frames of a static world.

::

    root/training/                     (root may be this folder itself)
      image_0/000027_10.png            left grey, time 1 (``_11``: time 2); 8-bit
      image_1/000027_10.png            right grey
      colored_0/ colored_1/            the colour cameras, for ``color=True``
      disp_occ/000027_10.png           disparity at time 1 on left1's grid: uint16 / 256 px, 0 = unknown
      flow_occ/000027_10.png           flow left1 -> left2: uint16 u, v: (value - 32768) / 64 px, and valid
      disp_noc/ flow_noc/              the same, only points visible in the other image (optional folders)
      calib/000027.txt                 P0, P1 (grey), P2, P3 (colour) (optional folder)

There is no disparity at time 2. The benchmark scores the grey and the colour images with the same truth.
"""

from pathlib import Path

from cgsf.calibration import Calibration
from cgsf.datasets import kitti
from cgsf.datasets.sample import Sample, Truth
from cgsf.formats import kitti_png


class Kitti2012:
    """KITTI Stereo and Flow 2012.

    Parameters
    ----------
    root : Path
        The folder that holds ``training`` and ``testing``, or the split's folder.
    split : {"training", "testing"}
    color : bool
        Take the colour cameras in place of the grey ones.
    """

    def __init__(self, root: Path, split: str = "training", color: bool = False) -> None:
        self.folder = kitti.split_folder(Path(root), split)
        self.has_truth = split == "training"
        self.color = color
        self.cameras = ("colored_0", "colored_1") if color else ("image_0", "image_1")
        self.names = kitti.frame_ids(self.folder / self.cameras[0])

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        frame = self.names[index]
        images = kitti.read_images(self.folder, *self.cameras, frame)
        calibration = None
        if (self.folder / "calib").is_dir():
            calibration = Calibration.read(self.folder / "calib" / f"{frame}.txt", color=self.color)
        return Sample(frame, *images, calibration, self._truth(frame) if self.has_truth else None)

    def _truth(self, frame: str) -> Truth:
        disparity = kitti_png.read_disparity(self.folder / "disp_occ" / f"{frame}_10.png")
        flow = kitti_png.read_flow(self.folder / "flow_occ" / f"{frame}_10.png")
        return Truth(
            disparity,
            None,
            flow,
            visible_stereo=kitti.visible(self.folder / "disp_noc", frame, disparity),
            visible_flow=kitti.visible(self.folder / "flow_noc", frame, flow),
        )
