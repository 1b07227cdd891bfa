"""What an IMU alone tells: attitude, heading, rest, and what every estimator takes from one of its samples."""
