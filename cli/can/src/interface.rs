//! A CAN interface of Linux: what it must be like, and the form of its frames.

use std::fs;
use std::path::Path;

use anyhow::{Context as _, bail};
use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, EmbeddedFrame as _, ExtendedId, Id, StandardId,
};
use tandem_board::{CanFrame, CanId};

/// Type of a CAN interface (`ARPHRD_CAN` in `linux/if_arp.h`).
const TYPE_CAN: &str = "280";
/// Largest unit of transfer of an interface with CAN FD, bytes (`CANFD_MTU` in `linux/can.h`).
const MTU_FD: u32 = 72;
/// Flag of an interface that is up (`IFF_UP` in `linux/if.h`).
const FLAG_UP: u32 = 1;

/// Checks that the interface exists, is one of CAN, carries CAN FD and is up. Changes nothing.
///
/// # Errors
/// What is missing, and the command that mends it.
pub(crate) fn check(name: &str) -> anyhow::Result<()> {
    check_in(Path::new("/sys/class/net"), name)
}

fn check_in(folder: &Path, name: &str) -> anyhow::Result<()> {
    let folder = folder.join(name);
    if !folder.exists() {
        bail!(
            "there is no such interface; `ip link add {name} type vcan` and \
             `ip link set {name} mtu {MTU_FD} up` make one, after `modprobe vcan`; for a bus \
             without SocketCAN there is `--can udp`"
        );
    }
    let read = |file: &str| {
        let path = folder.join(file);
        let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        Ok::<_, anyhow::Error>(text.trim().to_owned())
    };
    if read("type")? != TYPE_CAN {
        bail!("it is no CAN interface; `ip -details link show type vcan` lists virtual ones");
    }
    if read("mtu")?.parse::<u32>()? < MTU_FD {
        bail!("it does not carry CAN FD; `ip link set {name} mtu {MTU_FD}` lets it");
    }
    let flags = read("flags")?;
    if u32::from_str_radix(flags.trim_start_matches("0x"), 16)? & FLAG_UP == 0 {
        bail!("it is down; `ip link set {name} up` starts it");
    }
    Ok(())
}

/// Returns the frame in the form of the socket; `None` if it has none.
pub(crate) fn to_socket(frame: &CanFrame) -> Option<CanAnyFrame> {
    let id: Id = match frame.id() {
        CanId::Standard(id) => StandardId::new(id)?.into(),
        CanId::Extended(id) => ExtendedId::new(id)?.into(),
    };
    match frame.is_fd() {
        true => CanFdFrame::new(id, frame.data()).map(CanAnyFrame::Fd),
        false => CanDataFrame::new(id, frame.data()).map(CanAnyFrame::Normal),
    }
}

/// Returns the frame in the form of the run's bus; `None` for remote and error frames.
pub(crate) fn of_socket(frame: &CanAnyFrame) -> Option<CanFrame> {
    let (id, is_fd, data) = match frame {
        CanAnyFrame::Normal(frame) => (frame.id(), false, frame.data()),
        CanAnyFrame::Fd(frame) => (frame.id(), true, frame.data()),
        CanAnyFrame::Remote(_) | CanAnyFrame::Error(_) => return None,
    };
    let id = match id {
        Id::Standard(id) => CanId::Standard(id.as_raw()),
        Id::Extended(id) => CanId::Extended(id.as_raw()),
    };
    CanFrame::new(id, is_fd, data).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use socketcan::CanRemoteFrame;

    #[test]
    fn frames_keep_their_kind_id_and_data() {
        for (id, is_fd, length) in [
            (CanId::Standard(0x7FF), false, 8),
            (CanId::Standard(0), false, 0),
            (CanId::Extended(0x7FF), false, 3),
            (CanId::Standard(0x123), true, 8),
            (CanId::Extended(0x1FFF_FFFF), true, 64),
        ] {
            let data: Vec<u8> = (1..=length).collect();
            let frame = CanFrame::new(id, is_fd, &data).unwrap();
            let there = to_socket(&frame).unwrap();
            assert_eq!(of_socket(&there), Some(frame));
        }
        let remote = CanRemoteFrame::new_remote(StandardId::ZERO, 2).unwrap();
        assert_eq!(of_socket(&CanAnyFrame::Remote(remote)), None);
    }

    /// What is missing is told with the command that mends it.
    #[test]
    fn an_interface_is_checked() {
        let folder = std::env::temp_dir().join(format!("tandem-can-{}", std::process::id()));
        let of = |name: &str, [kind, mtu, flags]: [&str; 3]| {
            let interface = folder.join(name);
            fs::create_dir_all(&interface).unwrap();
            for (file, text) in [("type", kind), ("mtu", mtu), ("flags", flags)] {
                fs::write(interface.join(file), format!("{text}\n")).unwrap();
            }
            check_in(&folder, name).map_err(|error| error.to_string())
        };
        assert_eq!(of("vcan0", ["280", "72", "0xc1"]), Ok(()));
        for (figures, words) in [
            (["1", "1500", "0x1003"], "no CAN interface"),
            (["280", "16", "0xc1"], "`ip link set it mtu 72`"),
            (["280", "72", "0x80"], "`ip link set it up`"),
        ] {
            let refused = of("it", figures).unwrap_err();
            assert!(refused.contains(words), "{refused}");
        }
        let missing = check_in(&folder, "vcan1").unwrap_err().to_string();
        assert!(
            missing.contains("`ip link add vcan1 type vcan`"),
            "{missing}"
        );
        fs::remove_dir_all(&folder).unwrap();
    }
}
