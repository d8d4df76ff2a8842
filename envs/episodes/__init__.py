"""Recorded episodes: one type, LeRobot v3.0 on disk, clips for training."""

from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.episodes.formats.lerobot.writer import LeRobotWriter

__all__ = ["Episode", "EpisodeError", "LeRobotDataset", "LeRobotWriter"]
