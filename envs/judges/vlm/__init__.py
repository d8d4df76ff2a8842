"""The judge that asks a vision-language model, behind a server or in this process."""

from envs.judges.vlm.http_chat import HTTPChat
from envs.judges.vlm.judge import VLMJudge
from envs.judges.vlm.local_chat import LocalChat

__all__ = ["HTTPChat", "LocalChat", "VLMJudge"]
