"""The paper's remaining networks, from the package `nvidia-vipe` 1.2, behind the priors' protocols.

Only the networks are used, not the package's own pipeline. Weights come from files on this machine, and are loaded
without unpickling. Of the confidences that the networks give, GeoCalib's doubt of the focal length alone is used: what
those of depth mean is not written down, and for some it is an error, not a confidence.
"""
