# orthocas with its extras, a C compiler and CMake: docker build -t orthocas . ; docker run -it orthocas
FROM python:3.12-slim-bookworm
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev cmake make \
    && rm -rf /var/lib/apt/lists/*
COPY . /src
# Headers for C++ programs, a fifth of the core, are not needed to run it.
RUN pip install --no-cache-dir '/src[robots,view,mesh,mujoco]' \
    && rm -rf /src /usr/local/lib/python3.12/site-packages/cmeel.prefix/include \
        /usr/local/lib/python3.12/site-packages/casadi/include
RUN useradd --create-home user
USER user
WORKDIR /home/user
# An image that does not work is not built.
RUN orthocas doctor
EXPOSE 8080
CMD ["bash"]
