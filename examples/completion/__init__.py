"""What the example networks share: configuration, data, losses, the training loop, prediction and speed."""
