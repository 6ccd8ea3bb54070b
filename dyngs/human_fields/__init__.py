"""Fields of people, predicted from a few calibrated images by networks that were trained on others.

``people``: captured people, their bodies and images, in metres. ``features``: what images show at points, and small
networks. ``keypoint_nerf``: a density and blended colours (Mihajlovic et al. 2022). ``scene``: what is predicted, as
something to draw and to store. ``learner``: training and prediction.
"""
