"""Intersecting face pairs: traversal of two trees and the stages of the exact test."""
