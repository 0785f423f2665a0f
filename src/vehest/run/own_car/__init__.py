"""`vehest new`: logs -> inspect -> questions -> dataset -> write -> conf/dataset, conf/split and
pipelines.
"""
