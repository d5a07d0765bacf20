"""One detector a file, one for each effect that training can model: `detect(evidence) -> Finding`.

Each looks at what is there before training (frames, masks, cameras, points, the body fit, points followed through the
clip) and answers with a number beside its threshold. One that cannot measure says "unknown", which means off.
Effects hide each other, so they are told apart in order: lens, shutter and camera poses are solved for at once; gains are
taken off before colours are compared; and a shadow must follow the body, which what passes through does not.
"""
