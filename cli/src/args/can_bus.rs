//! The bus that `tandem run --can` names.

use std::str::FromStr;

/// Where other programs reach the bus of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CanBus {
    /// UDP multicast on this machine.
    Udp,
    /// This SocketCAN interface.
    Interface(String),
}

impl FromStr for CanBus {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        /// Bytes of the longest name in Linux.
        const LONGEST: usize = 15;
        let is_part = |byte: u8| byte.is_ascii_graphic() && byte != b'/' && byte != b':';
        let is_name = (1..=LONGEST).contains(&text.len()) && text.bytes().all(is_part);
        match text {
            "udp" => Ok(Self::Udp),
            name if is_name && !name.starts_with(['.', '-']) => {
                Ok(Self::Interface(name.to_owned()))
            }
            _ => Err("write udp, or the name of an interface such as vcan0"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buses_are_interfaces_or_udp() {
        let interface = |name: &str| Ok(CanBus::Interface(name.to_owned()));
        assert_eq!("udp".parse(), Ok(CanBus::Udp));
        assert_eq!("vcan0".parse(), interface("vcan0"));
        assert_eq!("a-name.of-15-by".parse(), interface("a-name.of-15-by"));
        for text in [
            "",
            ".",
            "..",
            "../lo",
            "-v",
            "a b",
            "a-name.of-16-byt",
            "lo\n",
        ] {
            assert!(text.parse::<CanBus>().is_err(), "{text}");
        }
    }
}
