"""One detector a file, one for each effect that training can model: `detect(evidence) -> Finding`.

Each measures what exists before training (frames, masks, cameras, points, the body fit, points followed through the
clip) and returns a value beside its threshold. A detector that cannot measure returns "unknown", which means off.
Effects hide each other, so they are separated in order: lens, shutter and camera poses are solved for at once; gains are
divided out before colours are compared; and a shadow must follow the body, which passers-by do not.
"""
