"""Radiance fields of people, predicted from a few calibrated images by networks trained on others.

``network``: image encoder and MLPs of both networks. ``keypoint_nerf``: KeypointNeRF (Mihajlovic
et al. 2022). ``eg_human_nerf``: EG-HumanNeRF (Wang, Kanamori and Endo 2024). ``prediction``:
training, prediction, and the predicted field as a scene.
"""
