"""The map from measurements that are refined in turns with it, as DROID-SLAM builds it. Import the modules directly."""

from __future__ import annotations
