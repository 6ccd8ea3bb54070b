"""Options of other Gaussian splatting programs, and the keys of dyngs with the same meaning."""

from __future__ import annotations

_OPTIONS = {
    "data.root=FOLDER": "data s source_path data_dir data_path",
    "run.dir=FOLDER": "m model_path o output output_dir output_path result_dir",
    "train.steps=N": "iterations iter max_steps max_num_iterations total_steps num_iters n",
    "train.save_every=N": "save_iterations checkpoint_iterations save_steps steps_per_save",
    "train.eval_every=N": "test_iterations eval_steps steps_per_eval_all_images",
    "train.ssim_weight=W": "lambda_dssim ssim_lambda",
    "strategy.max_gaussians=N": "cap_max max_cap max_splats",
    "strategy.grad_threshold=T": "densify_grad_threshold densify_grad_thresh grow_grad2d",
    "data.longest_side=PIXELS": "r resolution max_resolution",
    "data.downscale=FACTOR": "i images data_factor downscale_factor",
    "data.background=white": "w white_background",
    "data.test_every=N": "eval eval_interval",
    "model.rasterize_mode=antialiased": "antialiasing antialiased",
    "camera.refine=always": "pose_opt",
    "train.exposure=always": "use_bilateral_grid app_opt",
    "--resume RUN": "start_checkpoint ckpt load_dir",
}
_KEYS = {name: key for key, names in _OPTIONS.items() for name in names.split()}


def key_of_option(option: str) -> str | None:
    """Return the key for an option such as ``--max-steps``, with an example; None: unknown."""
    name = option.lstrip("-").partition("=")[0].replace("-", "_")
    return _KEYS.get(name.rpartition(".")[2])
