"""Stages of operators, and the operators that users make of them: one file a question."""
