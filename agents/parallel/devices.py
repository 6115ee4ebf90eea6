
import jax
class Placement:
    axis=None
    @classmethod
    def of(cls, devices, config, seeds): return cls()
    def shard(self, f): return f
    def put(self, s): return s
    def local(self, s): return s
    def __str__(self): return "cpu"
def become_devices(n): pass
