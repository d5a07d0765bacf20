"""Models of what only some clips call for, one file each; a model that is off costs nothing and changes no bit.

`shadow`, `motion_blur`, `rolling_shutter` and `camera_refinement` change how a frame is drawn: `frames` applies them.
`sky`, `transients` and `clothing` change what is learned; `antialias` and `view_dependence` need no more than a flag.
"""
