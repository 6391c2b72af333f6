//! Where a robot is: a serial port, or a socket.

use std::fmt;
use std::str::FromStr;

use serialport::SerialPortType;

use super::LinkError;

/// USB vendor of ST-LINKs: STMicroelectronics.
const ST: u16 = 0x0483;
/// USB products that are ST-LINKs with a virtual COM port: V2-1, V2-1 without mass storage, V3.
const ST_LINKS: [u16; 7] = [0x374B, 0x3752, 0x374E, 0x374F, 0x3753, 0x3754, 0x3757];

/// Where a robot is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A device such as `/dev/ttyACM0`, or a pseudo-terminal.
    Serial(String),
    /// Host and port, as of the emulator's `--vcp`.
    Tcp(String),
}

impl FromStr for Address {
    type Err = LinkError;

    fn from_str(text: &str) -> Result<Self, LinkError> {
        let bad = || LinkError::Address { given: text.to_owned() };
        match text.strip_prefix("tcp://") {
            Some(place) => {
                let (host, port) = place.rsplit_once(':').ok_or_else(bad)?;
                let is_place = !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port != 0);
                is_place.then(|| Self::Tcp(place.to_owned())).ok_or_else(bad)
            }
            None if text.is_empty() || text.contains("://") => Err(bad()),
            None => Ok(Self::Serial(text.to_owned())),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial(device) => write!(f, "{device}"),
            Self::Tcp(place) => write!(f, "tcp://{place}"),
        }
    }
}

impl Address {
    /// The port of the one ST-LINK that is plugged in.
    pub fn find() -> Result<Self, LinkError> {
        let ports = serialport::available_ports().map_err(LinkError::List)?;
        let is_board = |kind: &SerialPortType| match kind {
            SerialPortType::UsbPort(usb) => usb.vid == ST && ST_LINKS.contains(&usb.pid),
            _ => false,
        };
        let found = ports.into_iter().filter(|port| is_board(&port.port_type)).map(|port| port.port_name);
        match &found.collect::<Vec<_>>()[..] {
            [] => Err(LinkError::NotFound),
            [port] => Ok(Self::Serial(port.clone())),
            several => Err(LinkError::Several { ports: several.to_vec() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_devices_and_sockets() {
        let parsed = |text: &str| text.parse::<Address>().ok().map(|address| address.to_string());
        for good in ["/dev/ttyACM0", "COM3", "tcp://127.0.0.1:7000", "tcp://[::1]:7000"] {
            assert_eq!(parsed(good).as_deref(), Some(good));
        }
        for bad in [
            "",
            "tcp://",
            "tcp://127.0.0.1",
            "tcp://:7000",
            "tcp://here:0",
            "tcp://here:99999",
            "udp://here:1",
        ] {
            assert_eq!(parsed(bad), None, "{bad}");
        }
    }
}
