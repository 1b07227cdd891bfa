"""Where a person in a room is: particle filters and a Kalman filter on Doppler targets, and their calibration."""
