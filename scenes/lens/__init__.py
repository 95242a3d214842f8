"""Prescriptions of other optical programs: Zemax .zmx, CODE V .seq and batoid's YAML, in and out."""
