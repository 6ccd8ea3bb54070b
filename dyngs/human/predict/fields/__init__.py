"""Fields of people, predicted from a few calibrated images by networks that were trained on others.

``people``: captured people, their bodies and images, in metres. ``features``: what images show at
points, and small networks. ``network``: what both have in common. ``keypoint_nerf``: a density and
blended colours (Mihajlovic et al. 2022). ``eg_human_nerf``: few samples between the ``boundaries``
of a body (Wang, Kanamori and Endo 2024). ``scene``: what is predicted, as something to draw and to
store. ``learner``: training and prediction.
"""
