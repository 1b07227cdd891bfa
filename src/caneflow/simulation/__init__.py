"""Worlds, walks and sensor models: numbers out of a seeded numpy Generator."""
