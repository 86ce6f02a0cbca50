# The public names, listed here and nowhere else: type checkers read them, and so does __init__.py.
from etsplat.core.cameras import Cameras as Cameras
from etsplat.core.cameras import intrinsics as intrinsics
from etsplat.core.cameras import look_at as look_at
from etsplat.core.cameras import sphere_grid as sphere_grid
from etsplat.core.errors import InputError as InputError
from etsplat.core.rasterization import Cutoffs as Cutoffs
from etsplat.core.rasterization import HardRasterization as HardRasterization
from etsplat.core.rasterization import Rasterization as Rasterization
from etsplat.core.rasterization import TriangleStatistics as TriangleStatistics
from etsplat.core.registered_kernels import register_kernel as register_kernel
from etsplat.data.dataset import Dataset as Dataset
from etsplat.data.demo_object import demo_object as demo_object
from etsplat.data.hull import bounding_sphere as bounding_sphere
from etsplat.data.load import load_dataset as load_dataset
from etsplat.engines.choice import engine as engine
from etsplat.engines.choice import register_engine as register_engine
from etsplat.engines.threads import num_threads as num_threads
from etsplat.engines.threads import set_num_threads as set_num_threads
from etsplat.io.mesh_files import MeshFile as MeshFile
from etsplat.io.mesh_files import load_mesh as load_mesh
from etsplat.io.mesh_files import save_mesh as save_mesh
from etsplat.ops.antialias import rasterize_antialiased as rasterize_antialiased
from etsplat.ops.rasterize import rasterize as rasterize
from etsplat.ops.rasterize_hard import rasterize_hard as rasterize_hard
from etsplat.ops.rasterize_hard import render_opaque as render_opaque
from etsplat.report.html import write_report as write_report
from etsplat.tasks.reconstruct import ReconstructResult as ReconstructResult
from etsplat.tasks.reconstruct import reconstruct as reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig as ReconstructConfig
from etsplat.tasks.train import TrainResult as TrainResult
from etsplat.tasks.train import train as train
from etsplat.tasks.train_config import TrainConfig as TrainConfig

__version__: str
