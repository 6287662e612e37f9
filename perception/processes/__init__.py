"""The frames of a set side by side in processes of their own.

Threads of one interpreter hand it to and fro between the many short steps of a fit, and gain little by that;
processes do not. Frames reach them by memory that they share, the next ones while they are at work, and
detections come back by pipes.
"""
