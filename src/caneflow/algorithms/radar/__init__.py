"""Echoes to speeds: pulse-Doppler frames to the speed over ground, a Doppler module's block to its line."""
