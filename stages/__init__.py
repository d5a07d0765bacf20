"""The data flow; each stage is one file here and talks to the others only through the files it writes.

    video -> frames -+-> masks --+----------------+
                     |           v                |
                     +--------> sfm --+           |
                     |                v           v
                     +------------> smpl ------> survey -> train -+-> export
                                                                  +-> render
                                                                  +-> evaluate -> report

For a data set's folder `neuman` or `zju` stands in for frames and `calibrated` for sfm; masks and smpl then take what it
brought along. `pipelines.yaml` says which stages run and with what; `contract.py` says what a stage is.
`avatar/` is the mathematics, `formats/` the files, `estimators/` what stands in for data nobody gave us.
"""
