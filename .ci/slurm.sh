#!/usr/bin/env bash
# A Slurm of one node on this machine: set it up, run a command, and take it down. Needs root, on Debian or Ubuntu.
# Usage: .ci/slurm.sh COMMAND ...
set -euo pipefail

if ! command -v slurmctld >/dev/null; then
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends slurmctld slurmd slurm-client munge
fi
folder=$(mktemp -d -t r5dgs-slurm.XXXXXX)
chmod 755 "$folder"
mkdir -p "$folder/state" "$folder/spool" /run/munge
chown munge: /run/munge

host=$(hostname -s)
export SLURM_CONF=$folder/slurm.conf
# KillWait is short, so that tests that kill jobs do not wait.
cat >"$SLURM_CONF" <<CONFIGURATION
ClusterName=r5dgs
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldPort=16817
SlurmdPort=16818
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ReturnToService=2
KillWait=10
JobRequeue=1
MpiDefault=none
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(env -u OMP_NUM_THREADS nproc) State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONFIGURATION

started=()
end() {
  status=$?
  [ "$status" -eq 0 ] || tail -n 20 "$folder"/*.log >&2
  [ ${#started[@]} -eq 0 ] || kill "${started[@]}" 2>/dev/null || true
  wait
  rm -rf "$folder"
}
trap end EXIT
if ! munge -n >/dev/null 2>&1; then
  [ -f /etc/munge/munge.key ] || mungekey --create
  runuser -u munge -- munged --foreground >/dev/null 2>&1 &
  started+=($!)
  for _ in $(seq 50); do munge -n >/dev/null 2>&1 && break; sleep 0.1; done
fi
slurmctld -D >/dev/null 2>&1 &
started+=($!)
slurmd -D >/dev/null 2>&1 &
started+=($!)
for _ in $(seq 100); do sinfo -h -o %T 2>/dev/null | grep -q idle && break; sleep 0.3; done
sinfo
"$@"
