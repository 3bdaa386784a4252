"""Exposure, white balance, vignetting and response of photographs."""
