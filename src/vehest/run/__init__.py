"""Ingest, downsample, train, evaluate, report: configuration in, artefacts out.

Flow of a study: pipeline or overrides (`study`) -> jobs -> data at each rate (`runner`, `ingest`,
`downsample`) -> groups of trainings (`comparison`, `group`, `train`) -> calibration and evaluation
-> report -> results/ (`publishing`, `published`, `weights`). A stage makes one artefact, whose key
follows from versions, configuration and inputs. The other modules are commands that start from a
file or a finished model: `estimate`, `compare_files`, `identify`, `align`, `plot`, `replay`.
"""
