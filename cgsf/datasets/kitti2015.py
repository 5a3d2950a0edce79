"""KITTI Scene Flow 2015 (Menze and Geiger, CVPR 2015): 200 training frames, colour, two stereo pairs each.

::

    root/training/                     (root may be this folder itself)
      image_2/000003_10.png            left, time 1 (``_11``: time 2); 8-bit colour
      image_3/000003_10.png            right
      disp_occ_0/000003_10.png         disparity at time 1 on left1's grid: uint16 / 256 px, 0 = unknown
      disp_occ_1/000003_10.png         disparity at time 2 of the same points, also on **left1's** grid
      flow_occ/000003_10.png           flow left1 -> left2: uint16 u, v: (value - 32768) / 64 px, and valid
      disp_noc_0/ disp_noc_1/ flow_noc/   the same, only points visible in the other images (optional folders)
      obj_map/000003_10.png            uint8: 0 background, n the n-th moving object (optional folder)
      calib_cam_to_cam/000003.txt      rectified cameras P_rect_02, P_rect_03 (optional folder)

A split ``testing`` has images only.
"""

from pathlib import Path

import numpy as np

from cgsf.calibration import Calibration
from cgsf.datasets import kitti
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats import kitti_png
from cgsf.formats.images import decode


class Kitti2015:
    """KITTI Scene Flow 2015.

    Parameters
    ----------
    root : Path
        The folder that holds ``training`` and ``testing``, or the split's folder.
    split : {"training", "testing"}
    """

    def __init__(self, root: Path, split: str = "training") -> None:
        self.folder = kitti.split_folder(Path(root), split)
        self.has_truth = split == "training"
        self.names = kitti.frame_ids(self.folder / "image_2")

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        frame = self.names[index]
        images = kitti.read_images(self.folder, "image_2", "image_3", frame)
        calibration = None
        if (self.folder / "calib_cam_to_cam").is_dir():
            calibration = Calibration.read(self.folder / "calib_cam_to_cam" / f"{frame}.txt")
        return Sample(frame, *images, calibration, self._truth(frame) if self.has_truth else None)

    def _truth(self, frame: str) -> Truth:
        name = f"{frame}_10.png"
        disparity1 = kitti_png.read_disparity(self.folder / "disp_occ_0" / name)
        disparity2 = kitti_png.read_disparity(self.folder / "disp_occ_1" / name)
        flow = kitti_png.read_flow(self.folder / "flow_occ" / name)
        return Truth(
            disparity1,
            disparity2,
            flow,
            visible_stereo=kitti.visible(self.folder / "disp_noc_0", frame, disparity1),
            visible_change=kitti.visible(self.folder / "disp_noc_1", frame, disparity2),
            visible_flow=kitti.visible(self.folder / "flow_noc", frame, flow),
            objects=self._objects(frame),
        )

    def _objects(self, frame: str) -> np.ndarray | None:
        if not (self.folder / "obj_map").is_dir():
            return None
        path = self.folder / "obj_map" / f"{frame}_10.png"
        objects = decode(path)
        if objects.ndim != 2:
            raise InputError(f"{path}: an object map is grey, this is {objects.shape}")
        return objects
