"""A textured plane seen four times, and fake data-set trees with distractors."""

import json
from pathlib import Path

import cv2
import numpy as np

from cgsf.formats import kitti_png

H, W = 72, 110
DISPARITY, CHANGE, FLOW = 8.0, 2.0, (5.0, 3.0)


def plane(rng, height=H, width=W, channels=3):
    """uint8 images of a plane with disparity 8, disparity change 2, flow (5, 3): whole pixels, so no interpolation."""
    texture = rng.integers(0, 256, ((height + 40) // 4, (width + 80) // 4, channels), dtype=np.uint8)
    texture = cv2.resize(texture, (width + 80, height + 40), interpolation=cv2.INTER_CUBIC)
    texture = texture.reshape(height + 40, width + 80, channels)

    def view(dx, dy):
        return np.ascontiguousarray(texture[20 - dy : 20 - dy + height, 40 - dx : 40 - dx + width])

    return view(0, 0), view(-8, 0), view(5, 3), view(5 - 10, 3)


def write_images(folder: Path, images, names=("left1", "right1", "left2", "right2")):
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in names]
    for path, image in zip(paths, images, strict=True):
        assert cv2.imwrite(str(path), image)
    return paths


def write_frame(folder: Path, images, **more):
    """A frame folder as cgsf.datasets.folder reads it."""
    write_images(folder, images)
    shape = images[0].shape[:2]
    flow = np.broadcast_to(np.float32(FLOW), (*shape, 2))
    truth = {"D1": np.full(shape, DISPARITY, np.float32), "F": flow, "C": np.full(shape, CHANGE, np.float32),
             "valid": np.ones(shape, bool)} | more  # fmt: skip
    np.savez(folder / "gt.npz", **truth)
    calibration = {"fx": 100, "fy": 110, "cx": 50, "cy": 30, "baseline": 0.5}
    (folder / "calib.json").write_text(json.dumps(calibration))


def write_kitti(root: Path, images, frames=("000003", "000007"), year=2015):
    """A KITTI tree whose truth has the frame's number in its disparity, so that a mixed-up pair shows."""
    training = root / "training"
    left, right = ("image_2", "image_3") if year == 2015 else ("image_0", "image_1")
    shape = images[0].shape[:2]
    for frame in frames:
        number = float(frame)
        for time, (a, b) in {"10": images[:2], "11": images[2:]}.items():
            write_images(training / left, [a], [f"{frame}_{time}"])
            write_images(training / right, [b], [f"{frame}_{time}"])
        first, second = np.full(shape, 10 + number), np.full(shape, 30 + number)
        flow = np.stack([np.full(shape, number), np.full(shape, -number)], -1)
        first[0], second[1], flow[2] = np.nan, np.nan, np.nan
        maps = {"disp_occ_0": first, "disp_occ_1": second} if year == 2015 else {"disp_occ": first}
        for name, values in maps.items():
            hidden = values.copy()
            hidden[:, :4] = np.nan
            for folder, disparity in ((name, values), (name.replace("occ", "noc"), hidden)):
                kitti_png.write_disparity(training / folder / f"{frame}_10.png", disparity)
        hidden = flow.copy()
        hidden[:, :6] = np.nan
        kitti_png.write_flow(training / "flow_occ" / f"{frame}_10.png", flow)
        kitti_png.write_flow(training / "flow_noc" / f"{frame}_10.png", hidden)
        camera = f"{{}}: 700 0 600 {{}} 0 {700 + number} 170 0 0 0 1 0\n"
        names, folder = (("P_rect_02", "P_rect_03"), "calib_cam_to_cam") if year == 2015 else (("P0", "P1"), "calib")
        (training / folder).mkdir(exist_ok=True)
        text = camera.format(names[0], 0) + camera.format(names[1], -350)
        (training / folder / f"{frame}.txt").write_text(text)
    # what lies about in real trees: other times, other extensions, hidden files, stray truth
    write_images(training / left, images[:1], [f"{frames[0]}_09"])
    write_images(training / left, images[:1], ["preview"])
    (training / left / ".DS_Store").write_text("")
    (training / left / "Thumbs.db").write_text("")
    (training / left / "000099_10.png.part").write_text("")
    kitti_png.write_flow(training / "flow_occ" / "000001_10.png", np.zeros((*shape, 2)))
