"""Monitor of a space camera: changes of the camera's parameters from the shifts of light spots on its area CCDs.

The monitor sends light from pinholes through the camera's own optics back onto small area CCDs; the estimators are
those of paper 001 (Wang et al. 2018) and improved ones.
"""
