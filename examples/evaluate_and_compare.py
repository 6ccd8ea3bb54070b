"""Evaluate a run, and compare two models on its capture.

python examples/evaluate_and_compare.py runs/plush 2000
"""

from __future__ import annotations

import sys

import dyngs

run, steps = sys.argv[1], int(sys.argv[2])
report = dyngs.evaluate(run)
print(f"{report.psnr:.2f} dB, SSIM {report.ssim:.4f}, {report.num_gaussians:,} Gaussians")

capture = dyngs.load(run).run.config.data.root
result = dyngs.compare(capture, ["static", "static_mcmc"], steps=steps, out="compared")
for row in result.rows:
    print(f"{row['name']:12} {row['psnr']:.2f} dB, {row['mb']:.2f} MB, {row['seconds']:.0f} s")
print(result.files)
