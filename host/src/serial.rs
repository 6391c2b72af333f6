//! A sensor on a serial port of this PC: the same driver as on the microcontroller, over tokio.

use std::time::{Duration, Instant};

use embedded_io_adapters::tokio_1::FromTokio;
use scip::{Client, ClientConfig, ClientError, Clock, SensorInfo};
use tokio_serial::SerialPort as _;
use tokio_serial::{SerialPortBuilderExt, SerialStream};

/// Why there is no scan.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The port cannot be opened.
    #[error("{port}")]
    Open {
        /// As given.
        port: String,
        /// What the system said.
        source: tokio_serial::Error,
    },
    /// The sensor gives none.
    #[error("{port}")]
    Sensor {
        /// As given.
        port: String,
        /// What the driver said.
        source: ClientError<std::io::Error>,
    },
}

/// A sensor's identity and one of its scans.
#[derive(Debug)]
pub struct OneScan {
    /// What the sensor says of itself.
    pub info: SensorInfo,
    /// Bit rate that was agreed upon, bit/s.
    pub baud_rate: u32,
    /// Millimetres or codes, first step first.
    pub ranges_mm: Vec<u16>,
}

/// Connects to the sensor, takes a scan, and turns its laser off. The port may be tried so many times.
pub fn one_scan(port: &str, baud_rate: u32, attempts: u32) -> Result<OneScan, ScanError> {
    let open = |source| ScanError::Open { port: port.to_owned(), source };
    let io = |source: std::io::Error| open(source.into());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(io)?;
    let sensor = |source| ScanError::Sensor { port: port.to_owned(), source };
    runtime.block_on(async {
        let stream = tokio_serial::new(port, baud_rate).open_native_async().map_err(open)?;
        let config = ClientConfig { baud_rate, ..ClientConfig::default() };
        let mut client = Client::new(Port(FromTokio::new(stream)), TokioClock(Instant::now()), config);
        let mut ranges_mm = vec![0; MOST_BEAMS];
        let mut attempt = 1;
        let scan = loop {
            match client.next_scan(&mut ranges_mm).await {
                Ok(scan) => break scan,
                Err(error) if attempt >= attempts => return Err(sensor(error)),
                Err(_) => attempt += 1,
            }
        };
        ranges_mm.truncate(scan.ranges);
        client.stop().await.map_err(sensor)?;
        let info = client.info().cloned().ok_or_else(|| sensor(ClientError::NotFound))?;
        Ok(OneScan { info, baud_rate: client.baud_rate(), ranges_mm })
    })
}

/// More beams than any sensor of the family has.
const MOST_BEAMS: usize = 2048;

/// A serial port of this PC.
struct Port(FromTokio<SerialStream>);

impl embedded_io_async::ErrorType for Port {
    type Error = std::io::Error;
}

impl embedded_io_async::Read for Port {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Self::Error> {
        self.0.read(buffer).await
    }
}

impl embedded_io_async::Write for Port {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.0.write(bytes).await
    }

    async fn flush(&mut self) -> Result<(), Self::Error> {
        self.0.flush().await
    }
}

impl scip::SerialPort for Port {
    fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), Self::Error> {
        Ok(self.0.inner_mut().set_baud_rate(bits_per_second)?)
    }
}

/// This PC's clock, from when the port was opened.
struct TokioClock(Instant);

impl Clock for TokioClock {
    fn now_us(&self) -> u64 {
        self.0.elapsed().as_micros() as u64
    }

    async fn wait_until(&mut self, instant_us: u64) {
        tokio::time::sleep_until((self.0 + Duration::from_micros(instant_us)).into()).await;
    }
}
