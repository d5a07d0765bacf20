"""The data flow; each stage is one file here and reads only the files that other stages wrote.

    video -> frames -+-> masks --+----------------+
                     |           v                |
                     +--------> sfm --+           |
                     |                v           v
                     +------------> smpl ------> survey -> train -+-> export
                                                                  +-> render
                                                                  +-> evaluate

For a data set's folder, `neuman` or `zju` replaces frames and `calibrated` replaces sfm; masks and smpl then take the masks
and body poses of the data set. `pipelines.yaml` says which stages run and with which settings.

commands/    stages that no pipeline names: films, views, the demo clip, models, the report, pages of costs and fleets
contract.py  what a stage is: its settings, its job, its error
records.py   plain numpy records that the packages below exchange
hugs.py      the front for Python scripts
avatar/      what person and scene are: tensors in, tensors out
training/    how they are learned
synthetic/   the demo clip, made by computer with its truth
filming/     actors of avatars and motions, lit and placed, drawn as films
estimators/  masks, cameras and body poses, and the measures that decide on effects
formats/     readers and writers of files
"""
