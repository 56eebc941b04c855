"""The mini benchmark: simulated drives with three kinds of labels, the runs of the study, and their
tables.
"""
