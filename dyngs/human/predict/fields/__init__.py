"""Fields of people, predicted from a few calibrated images by networks that were trained on others.

``network``: the encoder of images and small networks, which both kinds share. ``keypoint_nerf``: a
density and blended colours (Mihajlovic et al. 2022). ``eg_human_nerf``: few samples between the
boundaries of a body (Wang, Kanamori and Endo 2024). ``prediction``: training, prediction, and the
predicted field as something to draw and to store.
"""
