"""DEV STUB, not committed."""
import sys, subprocess, os
from pathlib import Path
def main():
    a=sys.argv[1:]; get=lambda k:[x for x in a if x.startswith(k)][0].split("=",1)[1]
    out=Path(get("--output_dir")); seeds=get("--seeds").split(","); 
    rest=[x for x in a if not x.startswith(("--output_dir","--seeds","--jobs","--resume"))]
    for s in seeds:
        d=out/f"seed_{s}"; cfg=d/"checkpoints/last/pretrained_model/train_config.json"
        if cfg.is_file(): cmd=[f"--config_path={cfg}","--resume=true"]
        else:
            if d.exists(): import shutil; shutil.rmtree(d)
            cmd=[*rest,f"--seed={s}","--num_workers=0",f"--output_dir={d}"]
        r=subprocess.run([str(Path(sys.executable).with_name("lerobot-train")),*cmd])
        if r.returncode: sys.exit(r.returncode)
