"""A person from two neighbouring views, by stereo that is learned (GPS-Gaussian, Zheng et al.
2024).

``pairs`` chooses views, ``rectification`` turns two of them so that rows correspond, ``stereo``
finds the depth of every pixel, ``surface`` makes a Gaussian of it; ``learner`` trains and predicts.
"""
