"""Common code of the example networks: configuration, data, losses, the training loop, prediction
and speed.
"""
