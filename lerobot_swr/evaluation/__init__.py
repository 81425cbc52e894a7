"""Rollouts, behaviours, metrics, statistics, pictures and reports."""
