"""Detectors: conversion of photons to recorded frames."""
