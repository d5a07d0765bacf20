"""One detector a file, one for each effect that training can model: `detect(evidence) -> Finding`.

Each looks at what is there before training (frames, masks, cameras, points, the body fit, points followed through the
clip) and answers with a number beside its threshold. One that cannot measure says "unknown", which means off.
The order is that in which effects hide each other: what bends or shakes the camera before what colours a point, and what
passes through before what falls on the floor.
"""
