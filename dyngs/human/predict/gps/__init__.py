"""Gaussians from two neighbouring views by learned stereo (GPS-Gaussian, Zheng et al. 2024).

``rectification`` chooses and rectifies pairs of views; ``stereo`` estimates the disparity of every
pixel, turns pixels into Gaussians, and trains and predicts.
"""
