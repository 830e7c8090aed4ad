"""Robots: forward kinematics of many configurations, the link pairs that may meet, and answers by configuration."""
