"""From a first frame, its mask, a camera and a surface to the template of a scene."""
