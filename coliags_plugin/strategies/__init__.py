"""Strategies: growing, splitting and pruning between optimiser steps."""
