// Serves an arm to canprobe: g++ -std=c++17 -O2 arm.cpp -o arm && ./arm 5810. In place of `pose` and `move_to` stand
// the calls of your arm.
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <unistd.h>
#include <algorithm>
#include <array>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <optional>
#include <string>
using Clock = std::chrono::steady_clock;
using Pose = std::array<double, 16>;  // T_base_flange in rows, m
constexpr auto PERIOD = std::chrono::milliseconds(2), STOP_AFTER = std::chrono::milliseconds(100);
Pose pose{1, 0, 0, -0.12, 0, -1, 0, -0.1225, 0, 0, -1, 0.504, 0, 0, 0, 1};
void move_to(const Pose& target) { pose = target; }
bool say(int fd, const std::string& line) { return write(fd, line.data(), line.size()) == ssize_t(line.size()); }
std::optional<Pose> parse(const std::string& line) {  // {"T": [...]}; nothing of {"stop": true}
    size_t at = line.find('[');
    if (at == std::string::npos) return {};
    Pose numbers;
    const char* from = line.c_str() + at;
    char* to;
    for (double& number : numbers) number = std::strtod(from + 1, &to), from = to;
    return numbers;
}
void serve(int fd) {
    int one = 1;
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    if (!say(fd, "{\"canprobe_arm\": 1, \"stop_after_ms\": 100}\n")) return;
    std::optional<Pose> target;
    std::string rest;
    Clock::time_point heard, due = Clock::now();
    for (;;) {
        if (target && Clock::now() - heard < STOP_AFTER) move_to(*target);
        char number[32];
        std::string line = "{\"t_ns\": " + std::to_string(Clock::now().time_since_epoch().count()) + ", \"T\": [";
        for (double x : pose) line.append(number, std::snprintf(number, sizeof number, "%.9f, ", x));
        line.replace(line.size() - 2, 2, "]}\n");
        if (!say(fd, line)) return;
        for (due = std::max(due + PERIOD, Clock::now()); Clock::now() < due;) {
            pollfd ready{fd, POLLIN, 0};
            if (poll(&ready, 1, 1) <= 0) continue;
            char data[4096];
            ssize_t size = read(fd, data, sizeof data);
            if (size <= 0) return;  // lost: the arm stops, as nothing moves it any more
            rest.append(data, size);
            for (size_t end; (end = rest.find('\n')) != std::string::npos; rest.erase(0, end + 1))
                target = parse(rest.substr(0, end)), heard = Clock::now();
        }
    }
}
int main(int, char** argv) {
    std::signal(SIGPIPE, SIG_IGN);
    int server = socket(AF_INET, SOCK_STREAM, 0), one = 1;
    setsockopt(server, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one);
    sockaddr_in here{AF_INET, htons(std::atoi(argv[1])), {htonl(INADDR_LOOPBACK)}, {}};
    socklen_t size = sizeof here;
    if (bind(server, (sockaddr*)&here, size) || listen(server, 1)) return std::perror("listen"), 1;
    getsockname(server, (sockaddr*)&here, &size);
    std::printf("listening at 127.0.0.1:%d\n", ntohs(here.sin_port)), std::fflush(stdout);
    for (int fd; (fd = accept(server, nullptr, nullptr)) >= 0; close(fd)) serve(fd);
}
