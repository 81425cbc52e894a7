"""Rollouts, behaviours, metrics, checks, statistics, pictures and reports."""
