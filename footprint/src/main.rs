//! The driver alone, linked for the microcontroller, so that `cargo xtask size` can read its size. It is never run.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod probe {
    use core::convert::Infallible;
    use core::future::Future;
    use core::hint::black_box;
    use core::pin::pin;
    use core::task::{Context, Waker};

    use scip::{Client, ClientConfig, ClientError, Clock, Decoder, Scan, SerialPort};

    /// A port of which the linker knows nothing.
    struct Port;

    impl embedded_io_async::ErrorType for Port {
        type Error = Infallible;
    }

    impl embedded_io_async::Read for Port {
        async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
            Ok(black_box(buffer).len())
        }
    }

    impl embedded_io_async::Write for Port {
        async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
            Ok(black_box(bytes).len())
        }

        async fn flush(&mut self) -> Result<(), Infallible> {
            Ok(())
        }
    }

    impl SerialPort for Port {
        fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), Infallible> {
            black_box(bits_per_second);
            Ok(())
        }
    }

    struct NoClock;

    impl Clock for NoClock {
        fn now_us(&self) -> u64 {
            black_box(0)
        }

        async fn wait_until(&mut self, instant_us: u64) {
            black_box(instant_us);
        }
    }

    type Driver = Client<Port, NoClock>;

    fn next_scan<'a>(
        driver: &'a mut Driver,
        ranges_mm: &'a mut [u16],
    ) -> impl Future<Output = Result<Scan, ClientError<Infallible>>> + use<'a> {
        driver.next_scan(ranges_mm)
    }

    const fn size_of_returned<A, B, R>(_: &fn(A, B) -> R) -> usize {
        size_of::<R>()
    }

    // Statics of these names and sizes are what is read.
    #[unsafe(no_mangle)]
    static RAM_DECODER: [u8; size_of::<Decoder>()] = [0; _];
    #[unsafe(no_mangle)]
    static RAM_CLIENT: [u8; size_of::<Driver>()] = [0; _];
    #[unsafe(no_mangle)]
    static RAM_NEXT_SCAN: [u8; {
        size_of_returned(&(next_scan as fn(&'static mut Driver, &'static mut [u16]) -> _))
    }] = [0; _];

    #[unsafe(no_mangle)]
    extern "C" fn everything() {
        black_box((&RAM_DECODER, &RAM_CLIENT, &RAM_NEXT_SCAN));
        drive();
    }

    /// Where the linker puts what it makes of the client.
    #[inline(never)]
    fn drive() {
        let mut driver = Client::new(Port, NoClock, black_box(ClientConfig::default()));
        let mut ranges_mm = [0; 682];
        let call = pin!(driver.next_scan(&mut ranges_mm));
        let _ = black_box(call.poll(&mut Context::from_waker(Waker::noop())));
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        loop {}
    }
}

#[cfg(not(target_os = "none"))]
fn main() {
    println!("this is for the microcontroller; see `cargo xtask size`");
}
