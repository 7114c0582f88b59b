"""Cameras and temperature: drift models, couplings, identification, compensation."""
