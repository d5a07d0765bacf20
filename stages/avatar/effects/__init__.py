"""Effects that only some clips need, one file each; an effect that is off costs nothing and changes no bit.

`frames` applies `shadow`, `motion_blur` and `rolling_shutter` when a frame is drawn; training corrects cameras with
`camera_refinement`, adds the `sky` and learns `clothing`. `antialias` and `view_dependence` are flags.
"""
