"""Train a scene of images and cameras in memory: here a textured wall before nine cameras.

python examples/train_in_memory.py 500
"""

from __future__ import annotations

import sys

import numpy as np

import dyngs

steps = int(sys.argv[1])
width, height, focal = 64, 48, 60.0
intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
poses = np.stack([np.eye(4)] * 9)  # camera to world, OpenCV axes
# The first and the ninth image are held out, so they lie inside the row.
poses[:, 0, 3] = np.roll(np.linspace(-1, 1, 9), 4)

rows, columns = np.mgrid[:height, :width] + 0.5
images = []
for pose in poses:
    x = (columns - width / 2) / focal * 4 + pose[0, 3]  # on the wall z = 4
    y = (rows - height / 2) / focal * 4
    pattern = [np.sin(3 * x), np.sin(4 * y), np.cos(2 * x + y)]
    images.append(0.5 + 0.5 * np.stack(pattern, axis=-1))

cameras = dyngs.Cameras.from_matrices(poses, intrinsics, width, height, convention="opencv")
capture = dyngs.Capture.from_images(images, cameras)
scene = dyngs.train("static", data=capture, steps=steps, run_dir="runs/wall")
report = dyngs.evaluate(scene, capture=capture)
print(f"{scene}: {report.psnr:.2f} dB")
