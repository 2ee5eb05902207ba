#!/bin/bash
# The first process of a user-mode Linux: makes vcan0, drives with it, and switches the machine off.
# Arguments: the folder of the programs, which is also the machine's output.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
folder=$1
drive() {
    mount -t proc proc /proc
    mount -t sysfs sys /sys
    mkdir -p /dev/shm
    mount -t tmpfs tmp /dev/shm
    mount -t tmpfs tmp /mnt
    cd /mnt || return
    modules=/usr/lib/uml/modules/$(uname -r)/kernel
    for module in net/can/can net/can/can-raw drivers/net/can/dev/can-dev drivers/net/can/vcan; do
        insmod "$modules/$module.ko"
    done
    run() {
        "$folder/tandem" run --timing desktop --scenario free-lane --out report "$@"
        echo "status $?"
    }
    run --can vcan0
    ip link set lo up
    run --can lo
    ip link add vcan0 type vcan
    run --can vcan0
    ip link set vcan0 up mtu 16
    run --can vcan0
    ls
    ip link set vcan0 down
    ip link set vcan0 mtu 72 up
    # -L: the format of a log.
    touch "$folder/vcan0.log"
    candump -L vcan0 >"$folder/vcan0.log" &
    listener=$!
    (
        until [ "$(wc -l <"$folder/vcan0.log")" -gt 100 ]; do sleep 0.1; done
        cansend vcan0 '7A1##000112233445566778899AABB'
        cansend vcan0 1ABCDEF0#DEADBEEF
        cansend vcan0 7A2#R
    ) &
    run --can vcan0 --duration 8
    kill $listener
    cp report/candump.log "$folder/run.log"
    ps -e -o args= | grep -c "[t]andem-can"
}
drive >"$folder/said.txt" 2>&1
sync
echo o >/proc/sysrq-trigger
sleep 60
