"""A converter for drives of the lab, in which frame 3 kills the process that reads it, as a library
that crashes does.
"""

import multiprocessing
import os
import signal

from helpers.converters.lab_converter import Drive, Frame, Lab


class DeadlyFrame(Frame):
    def read(self):
        # not the process of the tests
        if self.number == 3 and multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().read()


class DeadlyDrive(Drive):
    def __init__(self, folder):
        super().__init__(folder)
        self.frames = [DeadlyFrame(frame.path, frame.number) for frame in self.frames]


class Deadly(Lab):
    def sequences(self):
        return [DeadlyDrive(folder) for folder in sorted(self.source.iterdir()) if folder.is_dir()]
